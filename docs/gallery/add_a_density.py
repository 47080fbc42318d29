"""
Add a density of one's own
==========================

A density is the probability of the next frame given those before. Here it is a matrix times the last frame, plus noise:
fitted by least squares to two minutes of walks, already a prior that every job takes.
"""

import torch

import controllers
import mapctl
import priors
from mapctl.features import LAYOUT
from mapctl.protocols import DataLimits, InitialStates, LastFrameState
from priors.markov_gaussian import MarkovGaussian
from scenes.film import film


class Linear(MarkovGaussian):
    name, limits = "linear", DataLimits(slowest=0.5, fastest=2.0, turn_rate=1.0)

    def __init__(self, frames, starts, values=LAYOUT.continuous):
        before, after = frames[:-1].double(), frames[1:].double()
        after[:, values:] = 8 * after[:, values:] - 4  # the others are contact bits, here as log odds
        self.matrix = torch.linalg.lstsq(before, after).solution
        self.sigma = (after - before @ self.matrix).std(dim=0)[:values].float()
        state = LastFrameState(starts.state.last_frame)
        self.initial_states = InitialStates(state, starts.speed, starts.names, starts.weight)

    def expect(self, before):
        return before @ self.matrix.to(before)


walking, curve = priors.load("locomotion").conditioned_on(["walk"]), mapctl.curves.wave(amplitude=0.3, length=5.0)
settings, generator = controllers.GenerateSettings(foot_cleanup=None), torch.Generator().manual_seed(1)
walks = controllers.generate(walking, seconds=120, settings=settings, generator=generator)
walk = controllers.follow(Linear(walks.features, walking.initial_states), curve)
print(f"{walk.status.text}: {100 * walk.ledger.summary()['path']['residual_mean']:.1f} cm beside the curve in the mean")
film([(walk.motion, curve)], "a-walk-by-a-linear-density.webp", size=(480, 270), fps=15)
