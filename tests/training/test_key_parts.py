"""Keys that tell less than whole poses, and the reference that they are seen from."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import generator

from mapctl.skeleton import CANONICAL
from priors.training.recipes.tweener import WHOLE, tell_parts
from priors.tweener import ToldParts, lead_reference

BATCH, FRAMES = 60, 90
LEGS = CANONICAL.indices(("leftLowerLeg", "rightLowerLeg", "leftFoot", "rightFoot", "leftToes", "rightToes"))
ARMS = CANONICAL.indices(("leftHand", "rightHand", "head", "leftLowerArm", "rightLowerArm"))


def rolls(seed=0):
    found = generator(seed)
    while True:
        yield float(torch.rand((), generator=found))


def told(**shares):
    known = torch.zeros(BATCH, FRAMES, dtype=torch.bool)
    known[:, [0, 30, 60, 61, 62, -1]] = True
    return tell_parts(known, torch.zeros(BATCH, FRAMES), replace(WHOLE, **shares), rolls()), known


def test_whole_keys_tell_everything():
    found, known = told()
    assert torch.equal(found.axes, known[..., None, None].expand_as(found.axes))
    assert torch.equal(found.heading, known)
    assert bool(found.view.isnan().all())


def test_drawings_tell_no_depth_and_are_seen_from_one_side():
    found, known = told(drawings=1.0)
    drawn = found.known & ~found.heading
    assert bool(found.view.isfinite().all())
    assert not bool(found.axes[drawn][:, 1:, 2].any())
    assert 0.5 < float(found.axes[drawn][:, 1:, :2].float().mean()) < 1
    assert bool((found.known <= known).all())


def straight(heading, told_parts):
    ground = torch.stack([torch.linspace(0, 2, FRAMES), torch.zeros(FRAMES)], dim=-1).expand(1, -1, -1)
    return lead_reference(ground, torch.full((1, FRAMES), heading), told_parts)


def places_only(frames):
    axes = torch.zeros(1, FRAMES, CANONICAL.num_joints, 3, dtype=torch.bool)
    axes[:, frames, 0, 0] = axes[:, frames, 0, 2] = True
    return ToldParts(axes, torch.zeros(1, FRAMES, dtype=torch.bool), torch.full((1,), torch.nan))


def test_a_reference_looks_along_its_way_where_no_heading_is_told():
    way, facing = straight(0.3, places_only([0, 40, FRAMES - 1]))
    assert facing[0].tolist() == pytest.approx([math.pi / 2] * FRAMES, abs=1e-5)
    assert way[0, 20, 0] == pytest.approx(float(way[0, 40, 0]) / 2, abs=1e-5)


def test_headings_that_are_told_lead_and_a_view_does_not_turn():
    some = places_only([0, 40, FRAMES - 1])
    some.heading[0, 40] = True
    assert bool(straight(0.3, some)[1] == pytest.approx(0.3))
    assert bool(straight(0.3, replace(some, view=torch.tensor([1.2])))[1] == pytest.approx(1.2))
