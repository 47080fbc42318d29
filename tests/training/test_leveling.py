"""Clips on the canonical body and a level floor: slopes are found and turned out, toes rest where the prior's do."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import moved, quat_xyzw
from performers import Performer

from mapctl import retarget, rotations
from mapctl.contacts import detect_contacts
from mapctl.features import GroundPose, encode
from mapctl.motion import Motion
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors.training.data import Cut, find_floor_slope, read_clip_features, stand_on_canonical, turn_level

pytestmark = pytest.mark.usefixtures("small_judgements")
SMALL = Performer(size=0.9, toe_height=-0.03)
"""Whose toes rest under the floor of the file."""


def sloping(motion: Motion, along_x: float, along_z: float) -> Motion:
    """As recorded where the floor rises so much a metre."""
    size = math.hypot(along_x, along_z)
    axis = torch.tensor([-along_z, 0.0, along_x], dtype=torch.float64) / size
    turn = quat_xyzw(math.atan(size) * axis).expand(motion.num_frames, 4)
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(turn, local[:, 0])
    return replace(motion, root_position=rotations.rotate(turn, motion.root_position), local_quat_xyzw=local)


def planted(motion: Motion):
    return detect_contacts(motion.joint_positions()[:, list(TOE_JOINTS)], float(motion.fps))


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.5, -1.6])
@pytest.mark.parametrize("slope", [0.022, -0.01])
def test_a_slope_along_the_walk_is_found_and_turned_out(slope, heading):
    level = moved(SMALL.walks(120), turn=heading, shift=(3.0, -2.0))
    along = (slope * math.sin(heading), slope * math.cos(heading))
    walked = sloping(level, *along)
    found = find_floor_slope(walked)
    assert found.tolist() == pytest.approx(along, abs=0.0015)
    turned = turn_level(walked, torch.tensor(along).double())
    assert (
        turned.joint_positions()[..., 1].diff(dim=0) - level.joint_positions()[..., 1].diff(dim=0)
    ).abs().max() < 1e-4
    before, after = (rotations.split_heading(motion.local_quat_xyzw[:, 0])[0] for motion in (level, turned))
    assert (before - after).abs().max() < 1e-3


def test_contacts_are_those_of_the_level_floor():
    level = SMALL.walks(150)
    walked = sloping(level, 0.0, 0.022)
    wanted, seen = planted(level), planted(walked)
    assert seen.float().mean() < 0.6 * wanted.float().mean()
    turned = planted(turn_level(walked, find_floor_slope(walked)))
    assert (turned == wanted).float().mean() > 0.98


@pytest.mark.parametrize(
    "motion",
    [Performer(stair=0.17).walks(150), SMALL.walks(1), SMALL.walks(6), sloping(SMALL.walks(150), 0.0, 0.09)],
    ids=["stair", "a frame", "a few frames", "a ramp"],
)
def test_what_is_no_fault_of_the_capture_stays(motion):
    assert find_floor_slope(motion).tolist() == [0, 0]
    assert turn_level(motion, torch.zeros(2).double()) is motion


def test_toes_that_stand_on_no_plane_tell_no_slope():
    rough = SMALL.walks(150)
    root = rough.root_position.clone()
    root[:, 1] += 0.05 * torch.sin(2.5 * root[:, 2] + 0.5)  # over a rolling ground, as slowly as toes that stand
    assert find_floor_slope(replace(rough, root_position=root)).tolist() == [0, 0]


@pytest.mark.parametrize("performer", [SMALL, Performer(size=1.2, leg=0.9, toe_height=0.1), Performer(leg=1.1)])
def test_features_decode_to_feet_that_stand_on_the_canonical_floor(performer):
    walked = sloping(performer.walks(120), 0.0, 0.02)
    rigmap = retarget.identify_rig(walked.skeleton)
    features, start = encode(stand_on_canonical(walked, rigmap))
    pose = BodyPose.of_features(features, start)
    toes = pose.joints_world(CANONICAL)[:, list(TOE_JOINTS)]
    stands = features[:, -2:] > 0.5
    assert 0.45 < float(stands.double().mean()) < 0.75
    assert toes[stands][:, 1].quantile(0.5) == pytest.approx(TOE_REST_HEIGHT, abs=0.004)
    assert toes[..., 1].min() > TOE_REST_HEIGHT - 0.01
    speed = torch.diff(toes, dim=0)[..., ::2].norm(dim=-1) * 30
    both = stands[1:] & stands[:-1]
    assert speed[both].mean() < 0.04
    assert speed[both].quantile(0.98) < 0.25


@pytest.mark.slow
def test_a_file_is_read_so_where_it_is_asked_for(tmp_path):
    walked = sloping(SMALL.walks(120), 0.0, 0.02)
    walked.save(tmp_path / "walk.bvh")
    plain, level = (read_clip_features(tmp_path / "walk.bvh", level=level) for level in (False, True))
    assert plain.shape == level.shape
    rests = [
        BodyPose.of_features(features, GroundPose.origin()).joints_world()[:, list(TOE_JOINTS), 1].quantile(0.1)
        for features in (plain, level)
    ]
    assert rests[0] < 0.01
    assert rests[1] == pytest.approx(TOE_REST_HEIGHT, abs=0.005)
    part = read_clip_features(tmp_path / "walk.bvh", cut=Cut(10, 100), level=True)
    assert len(part) == 90
