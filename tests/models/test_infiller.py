"""The network that proposes what is missing: what it does untrained, what it never does with any weights, its file."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_infiller import network, shown

from mapctl.skeleton import CANONICAL

JOINTS = CANONICAL.num_joints


def holed(frames=60, *, gaps=((20, 40),)):
    """The image, in single precision, of a walk with gaps."""
    known = torch.ones(1, frames, JOINTS, dtype=torch.bool)
    for start, stop in gaps:
        known[:, start:stop] = False
    image = shown(walk(frames, turn_rate=0.8), known)
    return single(image)


def single(image):
    floats = {name: getattr(image, name).float() for name in ("positions", "contacts", "ground", "heading")}
    return replace(image, **floats)


@pytest.mark.parametrize("frames", [1, 2, 3, 31, 33, 70])
def test_any_length_comes_back_as_it_is(frames):
    image = holed(frames, gaps=((frames // 2, frames // 2 + 1),) if frames > 1 else ())
    proposed = network(drawn=0.2)(image)
    assert proposed.positions.shape == (1, frames, JOINTS, 3)
    assert proposed.contacts.shape == (1, frames, 2)
    assert proposed.positions.isfinite().all()


def test_positions_that_are_not_known_are_not_seen():
    image, proposing = holed(), network(drawn=0.2)
    proposed = proposing(image).positions
    elsewhere = image.positions + torch.tensor([0.0, 1.0, 0.0])
    hidden, shown_there = (torch.where(image.known[..., None] == known, image.positions, elsewhere) for known in (1, 0))
    assert torch.equal(proposing(replace(image, positions=hidden)).positions, proposed)
    assert not torch.equal(proposing(replace(image, positions=shown_there)).positions, proposed)
