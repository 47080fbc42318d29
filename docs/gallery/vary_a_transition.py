"""
Go from pose to pose in many ways
=================================

There is more than one way from a pose to the next. The stitcher walks from both at once until its two sides meet: it
has one calm answer, and as many others as are asked for.
"""

from dataclasses import replace

import torch

import controllers
import priors
from controllers import GenerateSettings
from mapctl.recording.masks import Mask
from scenes import CameraSettings, Shot
from scenes.film import draw_strips_to, film

# Someone raises both hands: a sample of the prior of everyday motion. Frames 22 to 59 are made anew, in five ways.
general, stitcher = priors.load("general"), priors.load_stitcher()
start = next(k for k, clip in enumerate(general.initial_states.names) if "raise-up-left" in clip)
settings, generator = GenerateSettings(start=start), torch.Generator().manual_seed(2)
clip = controllers.generate(general, seconds=2.5, settings=settings, generator=generator).motion
drawing = stitcher.drawing(seed=1)
proposers = {"calm": stitcher, **{f"draw {number}": drawing.numbered(number) for number in range(1, 5)}}
ways = {name: controllers.infill(clip, each, [Mask("*", 22, 60)]).motion for name, each in proposers.items()}
shots = [
    Shot(replace(way, root_position=way.root_position + torch.tensor([1.2 * position, 0.0, 0.0])))
    for position, way in enumerate(ways.values())
]
camera = CameraSettings(azimuth_deg=0, elevation_deg=12, fov_deg=18)
film(shots, "five-ways-side-by-side.webp", camera=camera, size=(480, 200), fps=15)

# %%
# The same in stills: all begin and end alike, to the bit.

draw_strips_to([(name, way.slice(21, 61)) for name, way in ways.items()], "five-ways-in-stills.png", size=(900, 500))
