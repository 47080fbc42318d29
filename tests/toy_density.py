"""Densities of a few lines, one written from mapctl.protocols alone and one that has a mean only, made of the walks."""

import math
from dataclasses import dataclass

import torch
from helpers import corpus
from torch import Tensor

from mapctl.features import LAYOUT, ground_speed
from mapctl.protocols import DataLimits, Density, DiscreteChoices, InitialStates, LastFrameState

N = LAYOUT.continuous


@dataclass(frozen=True, eq=False)
class ToyDensity(Density[LastFrameState]):
    """Features that go back to a mean, each by itself; toes are planted as often as not, and rolled out as not."""

    initial_states: InitialStates[LastFrameState]
    mean: Tensor  # (continuous,)
    sigma: Tensor  # (continuous,)
    name, limits = "toy", DataLimits(slowest=0.5, fastest=2.0, turn_rate=1.0)

    def start_after(self, last_frame):
        return LastFrameState(last_frame)

    def advance(self, state, committed):
        return LastFrameState(committed[:, -1])

    def _expect(self, before):
        return self.mean + 0.8 * (before[..., :N] - self.mean)

    def _score(self, noise):
        return -(0.5 * noise.square() + self.sigma.log() + 0.5 * math.log(2 * math.pi)).sum(-1) - 2 * math.log(2)

    def _noise(self, features, state):
        expected = self._expect(torch.cat([state.last_frame[:, None], features[:, :-1]], dim=1))
        return (features[..., :N] - expected) / self.sigma

    def log_prob(self, features, state):
        return self._score(self._noise(features, state))

    def latents(self, features, state):
        bits = features[..., N:] > 0.5
        return DiscreteChoices(0 * bits[..., 0].long(), bits), self._noise(features, state)

    def plan(self, state, noise):
        return DiscreteChoices(torch.zeros(noise.shape[:2]).long(), torch.zeros(*noise.shape[:2], 2) > 0)

    def rollout(self, state, noise, plan):
        frames = [state.last_frame]
        for step, bits in zip(noise.unbind(1), plan.contacts.unbind(1), strict=True):
            frames.append(torch.cat([self._expect(frames[-1]) + self.sigma * step, bits.to(step)], dim=-1))
        return torch.stack(frames[1:], dim=1), self._score(noise)


def toy_density(dtype: torch.dtype = torch.float32) -> ToyDensity:
    """With the statistics of the walks, and the first frame of each to begin from."""
    clips = [clip.to(dtype) for clip in corpus().clips()]
    mean, sigma = (statistic(torch.cat(clips)[:, :N], 0) for statistic in (torch.mean, torch.std))
    speed = torch.stack([ground_speed(clip).mean() for clip in clips])
    names = tuple(f"walk {number}" for number in range(len(clips)))
    state = LastFrameState(torch.stack([clip[0] for clip in clips]))
    weight = torch.full_like(speed, 1 / len(clips))
    return ToyDensity(InitialStates(state, speed, names, weight), mean, 0.5 * sigma.clamp_min(0.01))
