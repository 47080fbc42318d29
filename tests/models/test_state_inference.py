"""The memory before a motion's first frames (Eq. 26)."""

from functools import cache

import torch
from helpers import tiny_density, walk

from mapctl.features import encode
from mapctl.solver.budget import Budget
from priors.lstm_gmm import density
from priors.lstm_gmm.density import infer_lstm_state
from priors.lstm_gmm.network import LstmState


@cache
def tiny():
    """Of weights so large that what it remembers makes a difference."""
    density = tiny_density(width=12)
    for layer in (density.reference.fc3, density.reference.out):
        layer.weight.mul_(4)
    return density


def frames(count=30, seed=3):
    return encode(walk(count, turn_rate=0.4, seed=seed))[0].float()


def nats(state, features):
    with torch.no_grad():
        return float(tiny().log_prob(features[None], state).sum())


def prior(state):
    """Of the memory, by the mean and spread of the known ones."""
    known = tiny().initial_states.state
    total = 0.0
    for mine, theirs in ((state.hidden, known.hidden), (state.cell, known.cell)):
        spread = theirs.std(dim=1, correction=0).clamp_min(0.05)
        total += float(0.5 * ((mine[:, 0] - theirs.mean(dim=1)) / spread).square().sum())
    return total


def test_the_first_frames_are_likelier_than_after_an_empty_memory_or_any_known_one():
    first = frames()[:10]
    found = tiny().infer_state(frames())
    assert nats(found, first) > nats(tiny().start_after(first[:1]), first) + 10
    known = tiny().initial_states.state
    for row in range(known.batch):
        other = known.pick(torch.tensor([row]))
        other = LstmState(first[:1], other.hidden, other.cell)
        assert nats(found, first) - prior(found) > nats(other, first) - prior(other)


def test_without_a_search_it_is_the_best_of_the_known_ones(monkeypatch):
    monkeypatch.setattr(density, "_BUDGET", Budget(evaluations=1))
    known = tiny().initial_states.state
    found = infer_lstm_state(tiny().reference, known, frames())
    apart = (known.hidden - found.hidden).abs().amax(dim=(0, 2))
    assert float(apart.min()) < 1e-5
