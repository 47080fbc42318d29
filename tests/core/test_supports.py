"""Supports of the toes: levels, slopes and steps that contacts show, and contacts that a capture shows."""

import math
from itertools import pairwise

import pytest
import torch
from helpers import walk

from controllers.denoising.denoise import list_foot_artefacts
from mapctl.contacts import compute_rest_log_probability, detect_contacts, fit_supports
from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES

POSITIONS = walk(330).joint_positions()
TOE_POSITIONS, HIPS = POSITIONS[:, CANONICAL.indices(TOES)], POSITIONS[:, 0]
PLANTED = detect_contacts(TOE_POSITIONS, 30)
CONTACTS = list(true_intervals(PLANTED))
NO_NOISE = torch.zeros(1, 1).double()


def lifted(heights):
    """The toes of the walk, each contact lifted by its height (metres), and swings linearly between."""
    toes, lifts = TOE_POSITIONS.clone(), torch.zeros(len(TOE_POSITIONS), 2).double()
    for foot in (0, 1):
        known = [
            (start, stop, height) for (at, start, stop), height in zip(CONTACTS, heights, strict=True) if at == foot
        ]
        frame = torch.arange(len(toes)).double()
        for (_, last, low), (first, _, high) in pairwise(known):
            share = ((frame - (last - 1)) / (first - (last - 1))).clamp(0, 1)
            between = (frame >= last) & (frame < first)
            lifts[between, foot] = (low + (high - low) * share)[between]
        for start, stop, height in known:
            lifts[start:stop, foot] = height
        lifts[: known[0][0], foot], lifts[known[-1][1] :, foot] = known[0][2], known[-1][2]
    toes[..., 1] += lifts
    return toes


def at_distance(function):
    """Heights of contacts by a function of the distance from the origin, metres."""
    return [function(float(TOE_POSITIONS[start:stop, foot, 2].median())) for foot, start, stop in CONTACTS]


LENGTH = float(TOE_POSITIONS[-1, 0, 2])
FLOORS = {
    "level": lambda z: 0.0,
    "boxes": lambda z: 0.3 * min(2, int(3 * max(z, 0) / LENGTH)),
    "down the stairs": lambda z: -0.18 * int(8 * max(z, 0) / LENGTH),
    "slope of 2 degrees": lambda z: math.tan(math.radians(2)) * z,
    "slope of 8 degrees": lambda z: math.tan(math.radians(8)) * z,
}


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("noise", [0.0, 0.008])
def test_toes_rest_on_the_floor_that_their_contacts_show(floor, noise):
    heights = at_distance(FLOORS[floor])
    toes = lifted(heights)
    toes[..., 1] += noise * torch.randn(toes.shape[:2], generator=torch.Generator().manual_seed(3)).double()
    supports = fit_supports(toes, PLANTED)
    for (foot, start, stop), height in zip(CONTACTS, heights, strict=True):
        assert float(supports[start, foot]) == pytest.approx(TOE_REST_HEIGHT + height, abs=0.01)
        assert supports[start:stop, foot].unique().numel() == 1
    found = list_foot_artefacts(TOES, toes, PLANTED, supports)
    assert not [artefact for artefact in found if artefact.kind == "float"]


@pytest.mark.parametrize("floor", [name for name in FLOORS if name != "down the stairs"])
def test_a_foot_in_the_air_is_listed_whatever_the_floor(floor):
    """On stairs with a contact or two a step it could as well be a step."""
    heights, raised = at_distance(FLOORS[floor]), 4
    heights[raised] += 0.05
    toes = lifted(heights)
    foot, start, stop = CONTACTS[raised]
    (found,) = [
        artefact
        for artefact in list_foot_artefacts(TOES, toes, PLANTED, fit_supports(toes, PLANTED))
        if artefact.kind == "float"
    ]
    assert (found.joint, found.start, found.stop) == (TOES[foot], start, stop)
    assert 3 < found.amount < 6


def resting(toes=TOE_POSITIONS, hips=HIPS, noise=NO_NOISE):
    return compute_rest_log_probability(toes, hips, 30.0, noise) > math.log(0.5)


def test_toes_rest_where_they_are_planted():
    rests = resting()
    assert float(rests[PLANTED].double().mean()) > 0.75
    assert float(PLANTED[rests].double().mean()) > 0.95


def test_a_body_that_lies_plants_nothing():
    lying = POSITIONS[..., [0, 2, 1]]
    assert not resting(lying[:, CANONICAL.indices(TOES)], lying[:, 0]).any()


def test_toes_that_travel_rest_only_as_far_as_noise_explains():
    drift = torch.arange(len(HIPS)).double()[:, None] / 30 * torch.tensor([0.6, 0.0, 0.0]).double()
    still = TOE_POSITIONS[:1].expand_as(TOE_POSITIONS)
    hips = still.mean(dim=1) + torch.tensor([0.0, 0.9, 0.0]).double()
    assert resting(still, hips).all()
    assert not resting(still + drift[:, None], hips + drift).any()
    assert resting(still + drift[:, None], hips + drift, NO_NOISE + 0.4).all()
