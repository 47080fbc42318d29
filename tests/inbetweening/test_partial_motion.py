"""Partial motions and position images: what follows from what is known, and the interpolation of the rest."""

import math
from dataclasses import replace

import torch
from captures import on_rig
from helpers import generator, moved, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_infiller import shown

from mapctl import rotations
from mapctl.inbetweening.partial_motion import (
    EFFECTORS,
    KnownParts,
    PartialMotion,
    interpolate_partial_motion,
    mirror_quats,
)
from mapctl.skeleton import CANONICAL, LIMBS

FRAMES = 40
MEAN = torch.nn.functional.normalize(
    torch.randn(CANONICAL.num_joints, 4, generator=torch.Generator().manual_seed(5)), dim=-1
)


def partial_motion(known, seed=0):
    """A made motion, facing anywhere, and numbers that mean nothing where it is not known."""
    motion = on_rig("canonical", FRAMES)
    heading, tilt = rotations.split_heading(motion.local_quat_xyzw[:, 0])
    quats = torch.cat([tilt[:, None], motion.local_quat_xyzw[:, 1:]], dim=1)[None]
    garbage = torch.nn.functional.normalize(
        torch.randn(quats.shape, generator=torch.Generator().manual_seed(seed)).double(), dim=-1
    )
    quats = torch.where(known.rotations[..., None], quats, garbage)
    root = torch.where(known.root[..., None], motion.root_position[None], 9.0 + seed)
    heading = torch.where(known.heading, rotations.unwrap_angle(heading)[None], 50.0 * seed)
    targets = torch.zeros(1, FRAMES, len(EFFECTORS), 3)
    offsets = CANONICAL.offsets[None]
    return PartialMotion(root, heading, quats, torch.full((1, FRAMES, 2), 0.5), targets, offsets, known)


def world_positions(motion):
    return motion.world_poses()[0]


def gap(start=10, stop=25):
    known = torch.ones(1, FRAMES, dtype=torch.bool)
    known[:, start:stop] = False
    return KnownParts.whole(known)


def test_unknown_values_do_not_matter_and_known_ones_stay():
    one, other = (interpolate_partial_motion(partial_motion(gap(), seed), MEAN, 0.9) for seed in (1, 2))
    torch.testing.assert_close(world_positions(one), world_positions(other), atol=1e-9, rtol=0)
    known = partial_motion(gap()).known.positions
    truth = on_rig("canonical", FRAMES).joint_positions()[None]
    torch.testing.assert_close(world_positions(one)[known], truth[known], atol=1e-9, rtol=0)


def test_unknown_limbs_bend_to_their_targets_and_known_ones_do_not():
    told = torch.zeros(1, FRAMES, len(EFFECTORS), dtype=torch.bool)
    hand, foot = EFFECTORS.index(CANONICAL.index("leftHand")), EFFECTORS.index(CANONICAL.index("rightFoot"))
    told[0, 17, hand] = told[0, 5, foot] = True
    motion = partial_motion(replace(gap(), effectors=told))
    plain = interpolate_partial_motion(replace(motion, known=gap()), MEAN, 0.9)
    positions, limb = world_positions(plain), LIMBS["leftHand"]
    position = positions[0, 17, limb.upper] + torch.tensor([0.1, 0.2, 0.3])
    motion.targets[0, 17, hand], motion.targets[0, 5, foot] = position, 5.0
    made = world_positions(interpolate_partial_motion(motion, MEAN, 0.9))
    torch.testing.assert_close(made[0, 17, limb.end].float(), position.float(), atol=2e-3, rtol=0)
    off = (made - positions)[0, :, limb.end].norm(dim=-1)
    assert 0 < float(off[11]) < float(off[14]) < float(off[17])
    assert float(torch.diff(off).abs().max()) < 0.4 * float(off[17]), "there and back"
    others = torch.ones(FRAMES, CANONICAL.num_joints, dtype=torch.bool)
    others[10:25, [limb.lower, limb.end]] = False
    torch.testing.assert_close(made[0][others], positions[0][others], atol=1e-9, rtol=0)


def test_a_mirrored_motion_has_mirrored_places():
    motion = partial_motion(KnownParts.whole(torch.ones(1, FRAMES, dtype=torch.bool)))
    flipped = world_positions(motion)[..., CANONICAL.mirror_partners(), :] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(world_positions(motion.mirrored()), flipped, atol=1e-9, rtol=0)
    torch.testing.assert_close(mirror_quats(mirror_quats(motion.quats)), motion.quats)


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
    assert (image.to_world(image.positions) - wanted)[known].abs().max() < 1e-12
    assert torch.allclose(image.to_world(image.from_world(wanted)), wanted, atol=1e-12)


@settings(max_examples=10)
@given(masks, st.floats(-math.pi, math.pi), st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_it_does_not_matter_where_the_motion_stands_and_faces(known, turn, shift):
    motion = walk(FRAMES, turn_rate=2.0)
    here, there = shown(motion, known), shown(moved(motion, turn=turn, shift=shift), known)
    assert torch.allclose(here.positions, there.positions, atol=1e-9)
    assert torch.equal(here.contacts, there.contacts)
    apart = rotations.wrap_angle(there.heading - here.heading - turn)
    assert apart.abs().max() < 1e-9
