"""
Add a term of one's own
=======================

A wish is a term: a function from a trial motion to an energy for each frame, whose sigma in physical units is its only
weight. Here the left wrist glides along a rail while one walks by.
"""

from dataclasses import dataclass

import torch

import controllers
import mapctl
import priors
from scenes import CameraSettings, Shot
from scenes.film import film
from scenes.props import build_target


@dataclass(frozen=True)
class Rail:  # along z, metres; the wrist is on it from the first second on
    x: float
    height: float
    name, unit, sigma = "rail", "m", 0.01

    def __call__(self, trial):
        return 0.5 * (self.residual(trial) / self.sigma).square()

    def residual(self, trial):
        away = trial.joint_world("leftHand")[..., :2] - torch.tensor([self.x, self.height])
        return torch.where(trial.seconds > 1.0, (away.square().sum(dim=-1) + 1e-12).sqrt(), 0.0)


line, rail = mapctl.curves.line(length=4.0), Rail(x=0.42, height=1.0)
walk = controllers.follow(priors.load("locomotion"), line, terms=[rail])
print(f"on the rail within {1000 * walk.ledger.summary()['rail']['residual_max']:.0f} mm")
bar, camera = [build_target((rail.x, rail.height, 0.05 * k)) for k in range(25, 80)], CameraSettings(azimuth_deg=70)
film([Shot(walk.motion, line)], "a-hand-on-a-rail.webp", camera=camera, props=bar, size=(480, 270), fps=15)
