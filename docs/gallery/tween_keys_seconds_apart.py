"""
Fill seconds between two keys
=============================

Two poses seven seconds apart hardly determine what lies between them. Motion DNA adds a few poses of another clip,
whose style the tweener takes on. Here the same two keys are filled under the DNA of raised hands, and of a run.
"""

from dataclasses import replace

import torch

import controllers
import mapctl
import mapctl.motion_dna
import priors
from controllers import GenerateSettings, Keys
from scenes import CameraSettings, Shot
from scenes.film import film

prior, line, generator = priors.load("locomotion"), mapctl.curves.line(length=6.0), torch.Generator().manual_seed(1)
keys = controllers.follow(prior, line, seconds=7.0, speed=0.8, generator=generator).motion
general, tweener, shots = priors.load("general"), priors.load_tweener(), []
for position, (name, colour) in enumerate({"raise-up-left": "#4c78a8", "run_masculine": "#e45756"}.items()):
    start = next(k for k, clip in enumerate(general.initial_states.names) if name in clip)
    settings, generator = GenerateSettings(start=start), torch.Generator().manual_seed(2)
    example = controllers.generate(general, seconds=4.0, settings=settings, generator=generator).motion
    styled = tweener.styled(mapctl.motion_dna.of(example, count=8))
    generated = controllers.tween(keys, Keys((0, keys.num_frames - 1)), styled).motion
    heights = generated.joint_positions()[:, generated.skeleton.indices(("leftHand", "rightHand")), 1]
    print(f"DNA of {name}: hands are {heights.mean():.2f} m high in the mean, and {heights.max():.2f} m at most")
    aside = generated.root_position + torch.tensor([1.6 * position, 0.0, 0.0])
    shots.append(Shot(replace(generated, root_position=aside), colour=colour))

# %%
# The first and the last pose are the same, to the bit. Blue walks with raised hands, red like a runner.

camera = CameraSettings("follow")
film(shots, "the-same-keys-under-two-motion-dnas.webp", camera=camera, size=(400, 225), fps=10)
