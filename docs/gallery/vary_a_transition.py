"""
Vary the transition between two poses
=====================================

Many motions lead from one pose to the next. The stitcher generates from both poses until its two sides meet: one mean
motion, and any number of samples.
"""

from dataclasses import replace
from pathlib import Path

import torch

import controllers
import priors
from controllers import GenerateSettings
from mapctl.recording.masks import Mask
from scenes import CameraSettings, Shot
from scenes.film import draw_strips_to, film

# Both hands are raised: a sample of the prior of everyday motion. Frames 22 to 59 are generated anew, five times.
general, stitcher = priors.load("general"), priors.load_stitcher()
start = next(k for k, clip in enumerate(general.initial_states.names) if "raise-up-left" in clip)
settings, generator = GenerateSettings(start=start), torch.Generator().manual_seed(2)
clip = controllers.generate(general, seconds=2.5, settings=settings, generator=generator).motion
proposers = {"calm": stitcher, **{f"draw {number}": stitcher.drawing(1, number) for number in range(1, 5)}}
variations = {name: controllers.infill(clip, each, [Mask("*", 22, 60)]).motion for name, each in proposers.items()}
shots = [
    Shot(replace(each, root_position=each.root_position + torch.tensor([1.2 * position, 0.0, 0.0])))
    for position, each in enumerate(variations.values())
]
camera = CameraSettings(azimuth_deg=0, elevation_deg=12, fov_deg=18)
film(shots, "five-variations-side-by-side.webp", camera=camera, size=(480, 200), fps=15)

# %%
# The same in stills: all begin and end alike, to the bit.

stills = [(name, each.slice(21, 61)) for name, each in variations.items()]
draw_strips_to(stills, Path("five-variations-in-stills.png"))
