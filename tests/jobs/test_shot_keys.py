"""Keys of poses, positions and facings in shots; ends in a clip's frame; loops; and the cost of constraints."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import walk

import priors
from controllers.shots.reaching import ReachTargets, go_down, measure_pose_error, meet_poses
from controllers.shots.request import Arrival, PoseKey, Reach, ShotRequest
from controllers.shots.seams import OVERLAP, arrive, close_loop
from controllers.shots.trajectory import Trajectory, plan_trajectory
from mapctl import curves, kinematics
from mapctl.errors import RequestError
from mapctl.intent.path import SpeedProfile
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOES

LINE = curves.line(length=4)
ENDS = list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))


@pytest.fixture(scope="module")
def inbetweener():
    return priors.load_inbetweener()


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return plan_trajectory(ShotRequest(LINE, seconds=4.0, speed=SpeedProfile.constant(1.0)))


@pytest.fixture(scope="module")
def walked(trajectory) -> Motion:
    motion = walk(len(trajectory.speeds))
    along = torch.zeros_like(motion.root_position)
    along[:, 2] = trajectory.arcs
    return replace(motion, root_position=motion.root_position * torch.tensor([0.0, 1.0, 0.0]) + along)


def crouched() -> Motion:
    """One frame with a lifted left arm and bent knees."""
    motion = walk(1)
    quats = motion.local_quat_xyzw.clone()
    for name, x in (("leftUpperArm", 0.9), ("leftLowerLeg", 0.3), ("rightLowerLeg", 0.3)):
        quats[0, CANONICAL.index(name)] = torch.tensor([math.sin(x / 2), 0.0, 0.0, math.cos(x / 2)])
    return replace(motion, local_quat_xyzw=quats)


# Poses, places, facings


@pytest.mark.parametrize(
    "key",
    [
        pytest.param(PoseKey(2.0, crouched()), marks=pytest.mark.slow),
        PoseKey(2.0, crouched(), hold_seconds=0.4, facing_deg=40.0),
        *(
            pytest.param(key, marks=pytest.mark.slow)
            for key in (
                PoseKey(2.0, place=(0.15, 2.1)),
                PoseKey(2.0, facing_deg=50.0),
                PoseKey(2.0, height=0.8),
                PoseKey(2.0, crouched(), root_only=True, facing_deg=-30.0),
            )
        ),
    ],
    ids=["pose", "held and turned", "place", "facing", "height", "hips"],
)
def test_a_key_is_met_exactly_and_the_rest_of_the_shot_stays(key, walked, trajectory, inbetweener):
    result, (met,) = meet_poses(walked, (key,), trajectory, inbetweener)
    metres, degrees = measure_pose_error(result, met)
    if key.gives_facing_alone:
        assert degrees < 0.1
    else:
        assert metres < 0.001
    if key.facing_deg is not None:
        there = float(torch.rad2deg(kinematics.heading(result.local_quat_xyzw[60:61, 0])))
        assert there == pytest.approx(key.facing_deg, abs=0.1)
    if key.place is not None:
        torch.testing.assert_close(result.root_position[60, ::2], torch.tensor(key.place).double(), atol=1e-3, rtol=0)
    if key.height is not None:
        assert float(result.root_position[60, 1]) == pytest.approx(0.8, abs=1e-3)
    torch.testing.assert_close(result.root_position[:20], walked.root_position[:20])
    torch.testing.assert_close(result.local_quat_xyzw[-15:], walked.local_quat_xyzw[-15:])
    peaks = body.measure_peaks(result.joint_positions()[:, ENDS], result.root_position, 30.0)
    assert peaks.step * 30 < 5.5


@pytest.mark.slow
def test_a_rough_key_may_be_missed_by_its_tolerance_and_no_more(walked, trajectory, inbetweener):
    key = PoseKey(2.0, crouched(), tolerance=0.12)
    result, (met,) = meet_poses(walked, (key,), trajectory, inbetweener)
    assert 0.01 < measure_pose_error(result, met)[0] <= 0.12
    facing = PoseKey(2.0, facing_deg=60.0, tolerance=20.0)
    result, (met,) = meet_poses(walked, (facing,), trajectory, inbetweener)
    assert 10 < measure_pose_error(result, met)[1] <= 20


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: PoseKey(1.0), "gives nothing"),
        (lambda: PoseKey(1.0, crouched(), tolerance={"leftHand": 0.1}), "one number"),
        (lambda: ShotRequest(LINE, poses=(PoseKey(1.0, facing_deg=0), PoseKey(1.05, facing_deg=9))), "two frames"),
        (lambda: ShotRequest(LINE, seconds=2.0, poses=(PoseKey(3.0, facing_deg=0.0),)), "not within the shot's 2 s"),
        (lambda: ShotRequest(LINE, loop=True), "closed curve"),
        (lambda: ShotRequest(curves.circle(radius=2), loop=True, seconds=3.0), "once around"),
    ],
    ids=["nothing", "tolerance", "two at once", "too late", "open loop", "loop with seconds"],
)
def test_keys_that_make_no_sense_are_refused(make, said):
    with pytest.raises(RequestError, match=said):
        make()


# Rough reaches


def test_a_rough_reach_asks_for_less(walked):
    hand = walked.joint_positions()[60, CANONICAL.index("leftHand")]
    position = hand + torch.tensor([0.3, 0.0, 0.0])
    given = {"leftHand": tuple(position.tolist())}

    def relaxed(tolerance) -> torch.Tensor:
        targets = ReachTargets.of((Reach(2.0, given, 0.0, tolerance),), walked.num_frames)
        return targets.relaxed(walked).targets.positions[60, CANONICAL.index("leftHand")]

    torch.testing.assert_close(relaxed(0.0), position)
    assert 0.07 < float((relaxed(0.1) - position).norm()) < 0.1
    torch.testing.assert_close(relaxed({"leftHand": 0.1}), relaxed(0.1))
    torch.testing.assert_close(relaxed({"rightHand": 0.1}), position)
    torch.testing.assert_close(relaxed(0.5), hand, atol=1e-6, rtol=0)


def test_hips_go_down_for_what_is_low_and_feet_stay_where_they_were(walked):
    feet = list(CANONICAL.indices(("leftFoot", "rightFoot", *TOES)))
    shoulder = walked.joint_positions()[60, CANONICAL.index("leftUpperArm")]
    low = shoulder + torch.tensor([0.15, -0.65, 0.1])
    reach, nobody = Reach(2.0, {"leftHand": tuple(low.tolist())}, 0.2), torch.zeros(walked.num_frames, dtype=torch.bool)
    result = go_down(walked, (reach,), nobody)
    dropped = (walked.root_position - result.root_position)[:, 1]
    assert 0.1 < float(dropped[60]) < 0.31
    assert float(dropped[[20, -15]].abs().max()) == 0
    torch.testing.assert_close(result.joint_positions()[:, feet], walked.joint_positions()[:, feet], atol=1e-3, rtol=0)
    posed = nobody.clone()
    posed[70] = True
    assert torch.equal(go_down(walked, (reach,), posed).root_position, walked.root_position)
    high = Reach(2.0, {"leftHand": tuple((shoulder + torch.tensor([0.2, 0.1, 0.2])).tolist())})
    assert go_down(walked, (high,), nobody) is walked


# Ends in a clip, loops


@pytest.mark.slow
def test_a_shot_ends_in_a_clips_frame_and_moves_as_the_clip_does(walked, inbetweener):
    arrival = Arrival.of(walk(120, turn_rate=0.4), 70).bring_to(LINE, 3.9)
    result = arrive(walked, arrival, inbetweener)
    assert result.num_frames == walked.num_frames
    torch.testing.assert_close(result.joint_positions()[-1], arrival.motion.joint_positions()[0], atol=1e-6, rtol=0)
    ahead = torch.cat([result.joint_positions(), arrival.motion.joint_positions()[1:3]])
    peaks = body.measure_peaks(ahead[-30:, ENDS], ahead[-30:, 0], 30.0)
    assert peaks.step * 30 < 5.5
    torch.testing.assert_close(result.root_position[:60], walked.root_position[:60])


@pytest.mark.slow
def test_a_loop_leads_from_its_last_frame_into_its_first(inbetweener):
    """One lap of a walk whose stride does not divide it."""
    frames = 127
    long = walk(frames + OVERLAP, turn_rate=2 * math.pi / (frames / 30))
    result = close_loop(long, frames, inbetweener)
    assert result.num_frames == frames

    def hardest(motion: Motion) -> float:
        twice = torch.cat([motion.joint_positions(), motion.joint_positions()])
        return 900 * float(torch.diff(twice, n=2, dim=0).norm(dim=-1)[:, ENDS].max())

    # A lap that is cut off has 197 m/s^2 where it begins again; laps put together without one made anew have 116.
    assert hardest(result) < 35 < 100 < hardest(long.slice(0, frames))
    torch.testing.assert_close(result.root_position[60:], long.root_position[60:frames])
