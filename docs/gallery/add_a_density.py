"""
Add a density of one's own
==========================

A density is the probability of the next frame given those before. Here it is a matrix times the last frame, plus noise:
fitted by least squares to two minutes of walks, already a prior that every job takes.
"""

import torch
from torch.distributions import Normal
from torch.nn.functional import binary_cross_entropy_with_logits

import controllers
import mapctl
import priors
from mapctl.features import LAYOUT
from mapctl.protocols import DataLimits, Density, DiscreteChoices, InitialStates, LastFrameState
from scenes.film import film

N = LAYOUT.continuous  # the features after them are contact bits


class Linear(Density[LastFrameState]):
    name, limits = "linear", DataLimits(slowest=0.5, fastest=2.0, turn_rate=1.0)

    def __init__(self, frames, starts):
        before, after = frames[:-1].double(), frames[1:].double()
        after[:, N:] = 8 * after[:, N:] - 4  # contact bits as log odds
        self.matrix = torch.linalg.lstsq(before, after).solution
        self.sigma = (after - before @ self.matrix).std(dim=0)[:N].float()
        state = LastFrameState(starts.state.last_frame)
        self.initial_states = InitialStates(state, starts.speed, starts.names, starts.weight)

    def expect(self, seen, state):
        before = torch.cat([state.last_frame[:, None], seen[:, :-1]], dim=1) @ self.matrix.to(seen)
        return before[..., :N], before[..., N:]

    def start_after(self, last_frame):
        return LastFrameState(last_frame)

    def advance(self, state, committed):
        return LastFrameState(committed[:, -1])

    def log_prob(self, features, state):
        mean, odds = self.expect(features, state)
        bits = binary_cross_entropy_with_logits(odds, features[..., N:], reduction="none")
        return Normal(mean, self.sigma).log_prob(features[..., :N]).sum(-1) - bits.sum(-1)

    def latents(self, features, state):
        noise = (features[..., :N] - self.expect(features, state)[0]) / self.sigma
        return self.choose(features[..., N:] > 0.5), noise

    def plan(self, state, noise):
        with torch.no_grad():
            return self.choose(self.roll(state, noise)[..., N:] > 0.5)

    def rollout(self, state, noise, plan):
        features = self.roll(state, noise, plan.contacts)
        return features, self.log_prob(features, state)

    def roll(self, state, noise, contacts=None):
        frames = [state.last_frame]
        for number, step in enumerate(noise.unbind(1)):
            expected = frames[-1] @ self.matrix.to(step)
            bits = expected[:, N:] > 0 if contacts is None else contacts[:, number]
            frames.append(torch.cat([expected[:, :N] + self.sigma * step, bits.to(step)], dim=-1))
        return torch.stack(frames[1:], dim=1)

    def choose(self, contacts):
        return DiscreteChoices(torch.zeros(contacts.shape[:2], dtype=torch.long), contacts)


walking, curve = priors.load("locomotion").conditioned_on(["walk"]), mapctl.curves.wave(amplitude=0.3, length=5.0)
settings, generator = controllers.GenerateSettings(foot_cleanup=None), torch.Generator().manual_seed(1)
walks = controllers.generate(walking, seconds=120, settings=settings, generator=generator)
walk = controllers.follow(Linear(walks.features, walking.initial_states), curve)
print(f"{walk.status.text}: {100 * walk.ledger.summary()['path']['residual_mean']:.1f} cm beside the curve in the mean")
film([(walk.motion, curve)], "a-walk-by-a-linear-density.webp", size=(480, 270), fps=15)
