"""Position images: what is known comes back, what is not known tells nothing."""

import math

import pytest
import torch
from helpers import generator, moved, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_infiller import TOES, shown

from mapctl import rotations
from mapctl.inbetweening import PositionImage
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


def test_everything_known_is_the_motion_seen_from_its_own_root():
    motion = walk(FRAMES, turn_rate=2.0)
    image = shown(motion)
    assert image.places[..., 0, ::2].abs().max() < 1e-12
    facing = rotations.about_y(-image.heading[0])
    turned = rotations.multiply(facing, motion.local_quat_xyzw[:, 0])
    assert rotations.split_heading(turned)[0].abs().max() < 1e-9


def with_hole(start, stop):
    known = torch.ones(1, FRAMES, CANONICAL.num_joints, dtype=torch.bool)
    known[:, start:stop] = False
    return known


@pytest.mark.parametrize("facing", [-3.0, 0.0, 1.5, 3.0])
def test_across_a_gap_the_heading_takes_the_short_way(facing):
    """Through a half turn too."""
    motion = moved(walk(FRAMES, turn_rate=0.5), turn=facing, shift=(0.0, 0.0))
    image = shown(motion, with_hole(10, 30))
    assert torch.diff(image.heading[0]).abs().max() < 0.03


def test_whole_turns_of_known_frames_are_counted():
    image = shown(walk(FRAMES, turn_rate=10.0))
    assert float(image.heading[0, -1] - image.heading[0, 0]) == pytest.approx(10.0 * (FRAMES - 1) / 30, abs=0.3)


def test_guesses_stay_guesses():
    known = torch.ones(1, FRAMES, CANONICAL.num_joints, dtype=torch.bool)
    known[..., 5] = False
    image = shown(walk(FRAMES), known)
    assert torch.allclose(image.to_world(image.places)[0], walk(FRAMES).joint_positions(), atol=1e-12)
    assert image.ever_known[0].tolist() == [joint != 5 for joint in range(CANONICAL.num_joints)]


def test_contacts_of_unknown_toes_are_even():
    known = with_hole(10, 20)
    known[:, 30:, TOES[1]] = False
    bits = shown(walk(FRAMES), known).contacts[0]
    assert (bits[10:20] == 0.5).all()
    assert (bits[30:, 1] == 0.5).all()
    assert (bits[30:, 0] == 1).all()
    assert (bits[:10] == 1).all()


@settings(max_examples=10)
@given(masks, st.floats(-math.pi, math.pi), st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_it_does_not_matter_where_the_motion_stands_and_faces(known, turn, shift):
    motion = walk(FRAMES, turn_rate=2.0)
    here, there = shown(motion, known), shown(moved(motion, turn=turn, shift=shift), known)
    assert torch.allclose(here.places, there.places, atol=1e-9)
    assert torch.equal(here.contacts, there.contacts)
    apart = rotations.wrap_angle(there.heading - here.heading - turn)
    assert apart.abs().max() < 1e-9


def test_frames_that_are_not_there_are_not_known():
    present = torch.ones(1, FRAMES, dtype=torch.bool)
    present[:, 25:] = False
    image = shown(walk(FRAMES), present=present)
    assert torch.equal(image.known, present[..., None].expand_as(image.known))
    short = shown(walk(25))
    assert torch.allclose(image.places[:, :25], short.places, atol=1e-12)


def test_a_batch_is_its_members():
    first, second = shown(walk(FRAMES), with_hole(5, 9)), shown(walk(FRAMES, turn_rate=1.0, seed=1), with_hole(20, 35))
    worlds = [image.to_world(image.places) for image in (first, second)]
    both = PositionImage.of_world(
        torch.cat(worlds),
        torch.cat([first.heading, second.heading]),
        torch.cat([first.contacts, second.contacts]),
        known=torch.cat([first.known, second.known]),
        present=torch.cat([first.present, second.present]),
        toes=TOES,
    )
    assert torch.allclose(both.places, torch.cat([first.places, second.places]), atol=1e-12)
    assert torch.allclose(both.ground, torch.cat([first.ground, second.ground]), atol=1e-12)


def test_frames_around_a_motion_tell_nothing_and_change_nothing_within():
    image = shown(walk(FRAMES, turn_rate=1.0), with_hole(0, 3))
    wide = image.extended(6)
    for name in ("places", "contacts", "known_axes", "present", "ground", "heading"):
        assert torch.equal(getattr(wide, name)[:, 6:-6], getattr(image, name))
        assert getattr(wide, name).shape[1] == FRAMES + 12
    outside = torch.cat([wide.known_axes[:, :6], wide.known_axes[:, -6:]])
    assert not outside.any()
    assert bool((wide.contacts[:, -6:] == 0.5).all())
    assert bool((wide.ground[:, -6:] == image.ground[:, -1:]).all())
    assert bool(wide.present.all())
