"""Partial motions: what follows from what is known, and the interpolation of the rest."""

from dataclasses import replace

import torch
from captures import on_rig

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
    places, limb = world_positions(plain), LIMBS["leftHand"]
    place = places[0, 17, limb.upper] + torch.tensor([0.1, 0.2, 0.3])
    motion.targets[0, 17, hand], motion.targets[0, 5, foot] = place, 5.0
    made = world_positions(interpolate_partial_motion(motion, MEAN, 0.9))
    torch.testing.assert_close(made[0, 17, limb.end].float(), place.float(), atol=2e-3, rtol=0)
    off = (made - places)[0, :, limb.end].norm(dim=-1)
    assert 0 < float(off[11]) < float(off[14]) < float(off[17])
    assert float(torch.diff(off).abs().max()) < 0.4 * float(off[17]), "there and back"
    others = torch.ones(FRAMES, CANONICAL.num_joints, dtype=torch.bool)
    others[10:25, [limb.lower, limb.end]] = False
    torch.testing.assert_close(made[0][others], places[0][others], atol=1e-9, rtol=0)


def test_a_mirrored_motion_has_mirrored_places():
    motion = partial_motion(KnownParts.whole(torch.ones(1, FRAMES, dtype=torch.bool)))
    flipped = world_positions(motion)[..., CANONICAL.mirror_partners(), :] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(world_positions(motion.mirrored()), flipped, atol=1e-9, rtol=0)
    torch.testing.assert_close(mirror_quats(mirror_quats(motion.quats)), motion.quats)
