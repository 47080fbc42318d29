"""
Clean a noisy clip
==================

In this capture joints tremble by 5 degrees and the hips by 2 cm. `denoise` finds out how noisy each joint is, lets a
network propose the motion behind it, and plants the feet again. Here the truth is known, so the error is, too.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import torch

import controllers
import mapctl
import priors
from scenes import CameraSettings, Shot
from scenes.film import film

prior, curve, draws = priors.load("locomotion"), mapctl.curves.wave(amplitude=0.3, length=5.0), torch.Generator()
truth = controllers.follow(prior, curve, generator=draws.manual_seed(7)).motion
# Quaternions hold half the angle, about each of three axes: together this is 5 degrees.
trembling = truth.local_quat_xyzw + 0.025 * torch.randn(truth.local_quat_xyzw.shape, generator=draws)
turned = torch.nn.functional.normalize(trembling, dim=-1)
shaken = truth.root_position + 0.02 * torch.randn(truth.num_frames, 3, generator=draws)
noisy = replace(truth, local_quat_xyzw=turned, root_position=shaken)
clean = controllers.denoise(noisy, priors.load_denoiser()).motion

aside = replace(noisy, root_position=noisy.root_position + torch.tensor([1.3, 0.0, 0.0]))
shots, camera = [Shot(clean), Shot(aside, colour="#999999")], CameraSettings(azimuth_deg=40)
film(shots, "noisy-capture-in-grey-and-the-clean-motion.webp", camera=camera, size=(480, 270), fps=15)

# %%
# Joints of the noisy clip and of the clean one against the truth, the mean over all joints.

for name, motion in (("noisy", noisy), ("clean", clean)):
    error = 100 * (motion.joint_positions() - truth.joint_positions()).norm(dim=-1).mean(dim=1)
    plt.plot(torch.arange(len(error)) / float(truth.fps), error, label=f"{name}: {error.mean():.1f} cm")
plt.gca().set(title="How far joints are from the truth", xlabel="seconds", ylabel="cm", ylim=(0, None))
plt.legend()
