"""Position images: what is known comes back, what is not known tells nothing."""

import math

import torch
from helpers import generator, moved, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_infiller import shown

from mapctl import rotations
from mapctl.skeleton import CANONICAL

FRAMES = 40


def drawn_masks(seed, share):
    """Of frames, and of joints in them."""
    draw = generator(seed)
    whole = torch.rand(1, FRAMES, 1, generator=draw) < share
    known = whole & (torch.rand(1, FRAMES, CANONICAL.num_joints, generator=draw) < 0.8)
    known[:, 4 + seed % 30, 0] = True  # without any known root there is no place to see the rest from
    return known


masks = st.builds(drawn_masks, st.integers(0, 1000), st.sampled_from([0.05, 0.3, 0.9]))


@settings(max_examples=10)
@given(masks)
def test_known_places_come_back_and_the_way_back_is_the_way_there(known):
    motion = walk(FRAMES, turn_rate=2.0)
    image, wanted = shown(motion, known), motion.joint_positions()[None]
    assert (image.to_world(image.places) - wanted)[known].abs().max() < 1e-12
    assert torch.allclose(image.to_world(image.from_world(wanted)), wanted, atol=1e-12)


@settings(max_examples=10)
@given(masks, st.floats(-math.pi, math.pi), st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_it_does_not_matter_where_the_motion_stands_and_faces(known, turn, shift):
    motion = walk(FRAMES, turn_rate=2.0)
    here, there = shown(motion, known), shown(moved(motion, turn=turn, shift=shift), known)
    assert torch.allclose(here.places, there.places, atol=1e-9)
    assert torch.equal(here.contacts, there.contacts)
    apart = rotations.wrap_angle(there.heading - here.heading - turn)
    assert apart.abs().max() < 1e-9
