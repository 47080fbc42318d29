"""
Walk along a curve
==================

Draw a curve, and a character walks along it. A learned prior scores how natural the walk is; the solver finds a likely
walk on the curve at the requested speed, with planted feet.
"""

import torch

import controllers
import mapctl
import priors
from scenes import CameraSettings, Shot
from scenes.film import film

prior = priors.load("locomotion")
curve = mapctl.curves.through([(0.0, 0.0), (0.4, 1.6), (1.8, 2.4), (3.2, 1.6), (4.6, 1.8)])
walk = controllers.follow(prior, curve, speed=1.2, generator=torch.Generator().manual_seed(1))
print(f"{walk.motion.seconds:.1f} s along {curve.length:.1f} m: {walk.status.text}")

# %%
# The red band is the curve, the yellow line the root trajectory. A ring shows a foot that is planted.

camera = CameraSettings(azimuth_deg=-20)
film([Shot(walk.motion, curve)], "walk-along-a-curve.webp", camera=camera, size=(480, 270), fps=15)

# %%
# Every request is a term of one energy, and the ledger has its residual in physical units: metres beside the
# curve, and metres per second at which planted feet slide.

for name, term in walk.ledger.summary().items():
    print(f"{name:8} {term['energy_nats']:6.1f} nats, {term['residual_mean']:.3f} {term['residual_unit']} in the mean")

# %%
# The motion is an ordinary clip: `save` writes the format that the file's ending names (BVH, GLB, USD, NPZ).

walk.motion.save("walk.bvh")
