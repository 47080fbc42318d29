"""The pose transformer: what it keeps, how it moves with its input, and what it is told."""

from dataclasses import replace

import pytest
import torch
from captures import on_rig
from tiny_transformer import save_tiny_transformer, tiny_transformer

import priors
from controllers.inbetweening.pipeline import CanonicalClip
from mapctl import rotations
from mapctl.errors import CheckpointError
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.partial_motion import KnownParts, interpolate_partial_motion
from mapctl.motion import Motion
from mapctl.recording.masks import ALL, Mask
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL
from priors import pose_transformer as module

FRAMES = 50
DRAWN = tiny_transformer(drawn=0.05)
GAP = [Mask(ALL, 15, 25)]
ARM = [Mask("leftLowerArm", 0, FRAMES), Mask("leftHand", 0, FRAMES)]


def query_of(masks, rig="canonical", frames=FRAMES):
    motion = on_rig(rig, frames)
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


def moved(motion: Motion, angle: float, shift) -> Motion:
    """Turned about +Y, then shifted."""
    turn = torch.tensor(angle, dtype=torch.float64)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(rotations.about_y(turn).expand(len(quats), 4), quats[:, 0])
    root = rotations.rotate_about_y(motion.root_position, turn) + torch.tensor(shift, dtype=torch.float64)
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def apart(one: Motion, other: Motion) -> float:
    return float((one.joint_positions() - other.joint_positions()).norm(dim=-1).max())


@pytest.mark.parametrize("masks", [GAP, ARM, [Mask(ALL, 0, 6), Mask(ALL, 44, FRAMES)]], ids=["gap", "arm", "ends"])
def test_untrained_it_interpolates_and_drawn_it_does_not(masks):
    query = query_of(masks)
    calm, drawn = (tiny_transformer(drawn=size).propose(query).motion for size in (0.0, 0.2))
    if masks is not ARM:  # joints that are never known take the mean pose, not the query's guess
        assert apart(calm, query.motion) < 0.1  # seams are blended
    assert apart(drawn, query.motion) > 0.15


def test_what_is_known_keeps_the_query_s_numbers():
    query = query_of(ARM)
    made = DRAWN.propose(query).motion
    assert torch.equal(made.root_position, query.motion.root_position)
    known = ~query.missing.joints
    turn = rotations.multiply(rotations.inverse(query.motion.local_quat_xyzw), made.local_quat_xyzw)
    assert float(rotations.to_rotation_vector(turn).norm(dim=-1)[known].max()) < 1e-6


def test_values_within_a_gap_do_not_matter():
    query = query_of(GAP)
    garbage = moved(query.motion, 2.0, (5.0, 1.0, -3.0))
    missing = query.missing.frames
    root = torch.where(missing[:, None], garbage.root_position, query.motion.root_position)
    quats = torch.where(missing[:, None, None], garbage.local_quat_xyzw, query.motion.local_quat_xyzw)
    other = replace(query, motion=replace(query.motion, root_position=root, local_quat_xyzw=quats))
    assert apart(DRAWN.propose(query).motion, DRAWN.propose(other).motion) < 1e-5


@pytest.mark.parametrize("masks", [GAP, ARM], ids=["gap", "arm"])
def test_it_turns_and_moves_with_its_input(masks):
    query = query_of(masks)
    there = replace(query, motion=moved(query.motion, 2.1, (7.0, 0.0, -3.0)))
    wanted = moved(DRAWN.propose(query).motion, 2.1, (7.0, 0.0, -3.0))
    assert apart(DRAWN.propose(there).motion, wanted) < 1e-4


def mirrored_query(query: GapQuery) -> GapQuery:
    partners = CANONICAL.mirror_partners()
    mask = MissingMask(query.missing.joints[:, partners], query.missing.root)
    return replace(query, motion=query.motion.mirror(), missing=mask)


@pytest.mark.parametrize("masks", [GAP, ARM], ids=["gap", "arm"])
def test_the_mirrored_question_has_the_mirrored_answer(masks):
    query = query_of(masks)
    one, other = DRAWN.propose(query), DRAWN.propose(mirrored_query(query))
    assert apart(one.motion.mirror(), other.motion) < 1e-4
    torch.testing.assert_close(one.contact_logits, other.contact_logits.flip(-1), atol=1e-4, rtol=1e-4)


def test_a_larger_body_gets_the_same_motion_on_its_own_bones():
    query = query_of(GAP, "daz")
    answer = DRAWN.propose(query)
    made = answer.motion
    lengths = (made.joint_positions()[:, 1:] - made.joint_positions()[:, list(CANONICAL.parents[1:])]).norm(dim=-1)
    own = query.motion.skeleton.offsets[1:].norm(dim=-1)
    torch.testing.assert_close(lengths, own.expand_as(lengths), atol=1e-6, rtol=0)
    assert answer.spread.shape == (query.motion.num_frames, CANONICAL.num_joints, 2)


def test_a_gap_longer_than_it_knows_is_left_and_said():
    frames = module.MAX_GAP_FRAMES + 40
    query = query_of([Mask(ALL, 15, 20), Mask(ALL, 30, 31 + module.MAX_GAP_FRAMES)], frames=frames)
    answer = DRAWN.propose(query)
    short, long = answer.attribute(query)
    assert (short.by, short.reason, long.by) == ("transformer", "", "interpolation")
    assert "8 s" in long.reason
    part = query.motion.slice(30, 31 + module.MAX_GAP_FRAMES)
    assert apart(answer.motion.slice(30, 31 + module.MAX_GAP_FRAMES), part) < 1e-9
    assert apart(answer.motion.slice(15, 20), query.motion.slice(15, 20)) > 0.005


def test_a_target_of_a_hand_changes_the_frames_beside_it_too():
    query = query_of(GAP)
    hand = CANONICAL.index("leftHand")
    places = query.motion.joint_positions().clone()
    places[20, hand] += torch.tensor([0.0, 0.3, 0.1])
    wanted = torch.zeros(places.shape[:2], dtype=torch.bool)
    wanted[20, hand] = True
    told = DRAWN.propose(replace(query, effector_targets=EffectorTargets(places, wanted))).motion
    free = DRAWN.propose(query).motion
    moved_by = (told.joint_positions() - free.joint_positions()).norm(dim=-1).amax(dim=1)
    assert DRAWN.takes_partial_keys
    assert float(moved_by[[19, 21]].min()) > 1e-4
    assert float(moved_by[:15].max()) < 1e-9


@pytest.mark.parametrize("faced", [True, False])
@pytest.mark.parametrize("tilted", [True, False])
def test_hips_keep_the_heading_or_the_tilt_that_is_known(faced, tilted):
    query = query_of(GAP)
    motion = DRAWN._show(query)
    frames = motion.heading.shape[1]
    gap = torch.zeros(1, frames, dtype=torch.bool)
    gap[:, 15:25] = True
    known = KnownParts.whole(~gap)
    turning = known.rotations.clone()
    turning[..., 0] |= gap & tilted
    known = replace(known, rotations=turning, heading=known.heading | (gap & faced))
    shown = interpolate_partial_motion(replace(motion, known=known), DRAWN.network.mean_quats, 0.9)
    hips = DRAWN.network(shown).local_matrix[0, :, 0]
    own_heading, tilt = rotations.split_heading(rotations.from_matrix(hips))
    _, shown_tilt = shown.heading[0], shown.quats[0, :, 0]
    heading_off = rotations.wrap_angle(own_heading - shown.heading[0]).abs()[15:25]
    tilt_off = (rotations.to_matrix(tilt) - rotations.to_matrix(shown_tilt)).abs().amax(dim=(1, 2))[15:25]
    assert (float(heading_off.max()) < 1e-5) == faced
    assert (float(tilt_off.max()) < 1e-5) == tilted


def test_weights_load_by_file_and_others_are_refused(tmp_path):
    path = save_tiny_transformer(tmp_path / "mine.safetensors", drawn=0.05)
    loaded = priors.load_inbetweener(str(path))
    query = query_of(GAP)
    assert apart(loaded.propose(query).motion, DRAWN.propose(query).motion) < 0.02  # float16
    with pytest.raises(CheckpointError, match="is no infiller"):
        priors.load_infiller(str(path))
    (tmp_path / "mine.json").write_text((tmp_path / "mine.json").read_text().replace('"width": 16', '"width": 32'))
    with pytest.raises(CheckpointError, match="do not fit"):
        priors.load_transformer(str(path))
