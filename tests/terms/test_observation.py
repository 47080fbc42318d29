"""The observation term against the same energies written out joint by joint."""

import math
from dataclasses import replace

import pytest
import torch
from catalogue import FRAMES, TERMS
from helpers import walk

from mapctl.features import LAYOUT, encode, integrate_root
from mapctl.terms import Observation
from mapctl.terms.trial import Trial


def trial_of(seed=1) -> Trial:
    features, start = encode(walk(FRAMES, seed=seed))
    features = features.unsqueeze(0)
    return Trial(
        features,
        start,
        features[..., : LAYOUT.continuous],
        features[..., 0],
        LAYOUT.pick(features, "contacts") > 0.5,
        torch.zeros(0, 21, 3).double(),
    )


def observed(trial: Trial, **changes) -> Observation:
    """What a capture without any noise shows of a trial."""
    ground, heading = integrate_root(trial.features[0], trial.start)
    height = LAYOUT.pick(trial.features[0], "root_height")
    root = torch.cat([ground[:, :1], height, ground[:, 1:]], dim=-1)
    seen = torch.ones(FRAMES, 21).bool()
    whole = Observation(root, heading, trial.features[0, :, 4:66], seen[:, 0], seen, 0.02, torch.full((21,), 0.1))
    return replace(whole, **changes)


def test_what_was_seen_exactly_costs_nothing():
    trial = trial_of()
    assert float(observed(trial)(trial).abs().max()) < 1e-12
    whole_turns = observed(trial, heading=observed(trial).heading + 4 * math.pi)
    assert float(whole_turns(trial).abs().max()) < 1e-9, "angles that differ by whole turns are the same"


def test_it_is_half_the_squares_over_the_sigmas():
    trial, term = trial_of(), replace(TERMS["observation"], outlier=1e9)
    ground, heading = integrate_root(trial.features[0], trial.start)
    expected = torch.zeros(FRAMES).double()
    for frame in range(FRAMES):
        place = torch.stack([ground[frame, 0], trial.features[0, frame, 3], ground[frame, 1]])
        if term.seen_root[frame]:
            expected[frame] += 0.5 * float((place - term.root[frame]).square().sum()) / term.sigma_root**2
        for joint in range(21):
            own, seen = trial.features[0, frame, 4:66], term.angles[frame]
            apart = own[3 * joint - 1 : 3 * joint + 2] - seen[3 * joint - 1 : 3 * joint + 2]
            if joint == 0:
                turn = math.remainder(float(heading[frame] - term.heading[frame]), 2 * math.pi)
                apart = torch.tensor([turn, *(own[:2] - seen[:2]).tolist()], dtype=torch.float64)
            if term.seen[frame, joint]:
                expected[frame] += 0.5 * float(apart.square().sum()) / float(term.sigma_angle[joint]) ** 2
    torch.testing.assert_close(term(trial)[0], expected, rtol=1e-9, atol=1e-9)


def test_a_spike_pulls_no_harder_than_an_outlier():
    trial = trial_of()
    whole = observed(trial)

    def pull(spike: float) -> float:
        angles = whole.angles.clone()
        angles[3, 20] += spike
        features = trial.features.clone().requires_grad_(True)
        energy = replace(whole, angles=angles)(replace(trial, features=features))
        (gradient,) = torch.autograd.grad(energy.sum(), features)
        return float(gradient[0, 3, 24].abs())

    assert pull(0.2) == pytest.approx(0.2 / 0.1**2)
    assert pull(0.4) == pytest.approx(4 / 0.1)
    assert pull(2.0) == pytest.approx(4 / 0.1)


def test_what_was_not_seen_says_nothing():
    trial = trial_of()
    whole = observed(trial)
    blind = replace(
        whole,
        angles=whole.angles + 3.0,
        root=whole.root + 1.0,
        seen=torch.zeros(FRAMES, 21).bool(),
        seen_root=torch.zeros(FRAMES).bool(),
    )
    assert float(blind(trial).abs().max()) == 0
    assert float(blind.residual(trial).abs().max()) == 0
    one = whole.seen.clone()
    one[:, 5] = False
    turned = whole.angles.clone()
    turned[:, 3 * 5 - 1 : 3 * 5 + 2] += 1.0
    assert float(replace(whole, angles=turned, seen=one)(trial).abs().max()) < 1e-12
