"""
Fill a gap, and a lost arm
==========================

A capture lost everything for a while, and later the right arm: `infill` generates both, and leaves known values
unchanged, to the bit.
"""

from dataclasses import replace

import torch

import controllers
import mapctl
import priors
from mapctl.recording.masks import Mask
from scenes import CameraSettings, Shot
from scenes.film import film

prior, curve = priors.load("locomotion"), mapctl.curves.wave(amplitude=0.3, length=4.2)
truth = controllers.follow(prior, curve, generator=torch.Generator().manual_seed(5)).motion
arm = ("rightUpperArm", "rightLowerArm", "rightHand")
lost = [Mask("*", 18, 60), *(Mask(joint, 70, 98) for joint in arm)]

# What a recorder leaves there: a frozen body, and an arm without rotations.
quats, positions = truth.local_quat_xyzw.clone(), truth.root_position.clone()
quats[18:60], positions[18:60] = quats[17], positions[17]
quats[70:98, truth.skeleton.indices(arm)] = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
broken = replace(truth, local_quat_xyzw=quats, root_position=positions)
whole = controllers.infill(broken, priors.load_transformer(), lost)
away = 100 * (whole.motion.joint_positions() - truth.joint_positions()).norm(dim=-1).mean(dim=1)
print(f"joints are {away[18:60].mean():.1f} cm from the truth in the gap, and {away[:18].max():.1f} cm before it")

# %%
# Grey is what was captured. What comes back walks beside it.

aside = replace(broken, root_position=broken.root_position - torch.tensor([1.3, 0.0, 0.0]))
shots, camera = [Shot(whole.motion), Shot(aside, colour="#999999")], CameraSettings(azimuth_deg=-40)
film(shots, "broken-capture-in-grey-and-the-whole-motion.webp", camera=camera, size=(480, 270), fps=15)
