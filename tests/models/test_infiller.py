"""The network that proposes what is missing: what it does untrained, what it never does with any weights, its file."""

from dataclasses import replace

import pytest
import torch
from helpers import generator, walk
from tiny_infiller import CONFIG, network, shown

from mapctl.skeleton import CANONICAL

JOINTS = CANONICAL.num_joints
ARCHITECTURES = ("skips", "image")
DRAWN = 0.2


def holed(frames=60, *, gaps=((20, 40),), turn_rate=0.8, seed=0, motion=None):
    """The image, in single precision, of a walk with gaps."""
    known = torch.ones(1, frames, JOINTS, dtype=torch.bool)
    for start, stop in gaps:
        known[:, start:stop] = False
    image = shown(walk(frames, turn_rate=turn_rate, seed=seed) if motion is None else motion, known)
    return single(image)


def single(image):
    floats = {name: getattr(image, name).float() for name in ("positions", "contacts", "ground", "heading")}
    return replace(image, **floats)


def of(architecture):
    return replace(CONFIG, architecture=architecture)


def test_untrained_it_draws_straight_lines():
    image = holed()
    proposed = network()(image)
    assert torch.equal(proposed.positions, image.positions)
    assert not proposed.contacts.any()


@pytest.mark.parametrize("frames", [1, 2, 3, 31, 33, 70])
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_any_length_comes_back_as_it_is(architecture, frames):
    image = holed(frames, gaps=((frames // 2, frames // 2 + 1),) if frames > 1 else ())
    proposed = network(drawn=DRAWN, config=of(architecture))(image)
    assert proposed.positions.shape == (1, frames, JOINTS, 3)
    assert proposed.contacts.shape == (1, frames, 2)
    assert proposed.positions.isfinite().all()


def test_known_places_stay_to_the_bit():
    known = torch.rand(1, 60, JOINTS, generator=generator()) < 0.6
    image = single(shown(walk(60), known))
    proposed = network(drawn=DRAWN)(image)
    assert torch.equal(proposed.positions[known], image.positions[known])
    assert (proposed.positions != image.positions).any()
