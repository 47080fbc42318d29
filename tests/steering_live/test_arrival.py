"""Orders to be somewhere at a time, with an untrained density and stitcher: exact, and steered on from there."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_steering import AHEAD, DENSITY, begun
from tiny_stitcher import tiny_stitcher

from controllers.steering import steer
from controllers.steering.arrival import Approach, Arriver
from controllers.steering.loop import Recorder, StreamClock, drive
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Arrival, Command, CommandTrack
from mapctl.metrics.arrivals import measure_arrivals
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL, Skeleton

ARRIVER = Arriver(tiny_stitcher())  # 23 frames between two poses at most


def play(*orders, frames=70, state=None):
    """Play orders at their times, after a start ahead; returns the recorder and the track."""
    track = CommandTrack(
        (0.0, *(time for time, _ in orders)), (AHEAD, *(replace(AHEAD, arrival=order) for _, order in orders))
    )
    recorder = Recorder()
    begin, first = begun() if state is None else state
    recorder.show(first, 0.0)
    drive(begin, track, [recorder], frames=frames, clock=StreamClock(), stepper=ARRIVER)
    return recorder, track


def errors(recorder, track):
    (row,) = measure_arrivals(recorder.motion(), track, [refusal.order for refusal in recorder.refusals])
    return row


@pytest.mark.slow
@pytest.mark.parametrize("facing", [None, -2.0])
def test_a_near_place_is_reached_on_the_frame(facing):
    recorder, track = play((0.2, Arrival((0.5, 0.4), 0.9, facing)))
    row = errors(recorder, track)
    assert row["frame"] == 27
    assert row["place_error_cm"] < 0.1
    assert facing is None or row["facing_error_deg"] < 0.1


@pytest.mark.slow
def test_a_far_place_is_walked_to_first_and_steered_from_there():
    recorder, track = play((0.2, Arrival((0.3, 1.5), 2.0, 0.5)), frames=80)
    assert errors(recorder, track)["place_error_cm"] < 0.1
    searched = [piece.evaluations > 0 for piece in recorder.pieces[1:]]
    assert searched[:3] == [True, True, True]  # walked
    assert not all(searched[3:20])  # stitched
    assert all(searched[-4:])  # steered on
    steps = recorder.motion().joint_positions().diff(dim=0).norm(dim=-1)
    assert bool(steps.isfinite().all())


@pytest.mark.slow
def test_a_pose_is_taken():
    pose = to_canonical(walk(40))[0].slice(17, 18)
    recorder, track = play((0.2, Arrival((0.2, 0.3), 0.9, 0.3, pose)))
    row = errors(recorder, track)
    assert row["pose_error_cm"] < 0.1
    assert row["place_error_cm"] < 0.1


def test_frames_meet_those_before_and_after_the_way():
    """The way begins where the walk was, and the walk goes on where the way ended."""
    recorder, _ = play((0.2, Arrival((0.2, 0.5), 0.9)))
    joints = recorder.motion().joint_positions()
    step = joints.diff(dim=0).norm(dim=-1).amax(dim=-1)
    assert float(step[[5, 6, 7]].max()) < 3 * float(step[8:26].max())


@pytest.mark.slow
def test_a_new_command_on_the_way_leaves_it_at_once():
    track = CommandTrack((0.0, 0.2, 0.5), (AHEAD, replace(AHEAD, arrival=Arrival((0.5, 0.4), 0.9)), AHEAD))
    recorder = Recorder()
    state, first = begun()
    recorder.show(first, 0.0)
    state, _ = drive(state, track, [recorder], frames=40, clock=StreamClock(), stepper=ARRIVER)
    assert state.approach.order is None
    assert recorder.pieces[-1].evaluations > 0


@pytest.mark.slow
def test_who_cannot_goes_on_as_before():
    """Also where the rest of the command would have been to stand."""
    stand = replace(AHEAD, speed=0.0, heading=1.0, arrival=Arrival((50.0, 0.0), 0.9))
    track, recorder = CommandTrack((0.0, 0.2), (AHEAD, stand)), Recorder()
    state, first = begun()
    recorder.show(first, 0.0)
    drive(state, track, [recorder], frames=40, clock=StreamClock(), stepper=ARRIVER)
    plain, _ = play(frames=40)
    assert len(recorder.refusals) == 1
    assert torch.equal(recorder.motion().root_position, plain.motion().root_position)


@pytest.mark.slow
def test_what_nobody_can_is_refused_once_with_numbers_and_changes_nothing():
    recorder, track = play((0.2, Arrival((50.0, 0.0), 0.9)), (0.5, Arrival((0.0, 0.0), 0.5)))
    told = [refusal.reason for refusal in recorder.refusals]
    assert len(told) == 2
    assert "50.0 m away, in 0.6 s is not obeyed: it needs 8" in told[0]
    assert "nobody comes anywhere in less" in told[1]
    assert measure_arrivals(recorder.motion(), track, [refusal.order for refusal in recorder.refusals]) == []
    plain, _ = play()
    assert torch.equal(recorder.motion().root_position, plain.motion().root_position)


@pytest.mark.slow
def test_another_body_comes_to_the_same_place():
    tall = Skeleton(CANONICAL.names, CANONICAL.parents, 1.3 * CANONICAL.offsets, CANONICAL.end_offsets)
    settings = begun()[0].settings
    state = steer.begin(DENSITY, AHEAD, generator=torch.Generator().manual_seed(0), settings=settings, skeleton=tall)
    recorder, track = play((0.2, Arrival((0.5, 0.4), 0.9, 1.0)), state=state)
    assert errors(recorder, track)["place_error_cm"] < 0.1


def test_steps_are_pure():
    state, _ = begun()
    command = replace(AHEAD, arrival=Arrival((0.3, 0.4), 0.6))
    one, two = (ARRIVER(state, command) for _ in range(2))
    assert torch.equal(one[1].motion.root_position, two[1].motion.root_position)
    assert isinstance(one[0].approach, Approach)
    assert one[0].frames == 1 + state.settings.commit
    assert round(PRIOR_FPS) == 30


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_an_order_has_finite_numbers(wrong):
    for order in (((wrong, 0.0), 1.0, None), ((0.0, 0.0), wrong, None), ((0.0, 0.0), 1.0, wrong)):
        with pytest.raises(RequestError, match="finite"):
            Arrival(*order)


def test_a_command_without_an_order_is_steered_as_ever():
    state, _ = begun()
    one, two = steer.step(state, AHEAD), ARRIVER(state, AHEAD)
    assert torch.equal(one[1].motion.root_position, two[1].motion.root_position)
    assert Command(1.0, 0.0).arrival is None


def test_the_first_step_is_steered_towards_the_place_and_plays_while_the_way_is_worked_out():
    state, _ = begun()
    for _ in range(2):
        state, _ = ARRIVER(state, AHEAD)
    by, here = state.frames / PRIOR_FPS + 0.6, state.committed.place.position_xz.tolist()
    plain = ARRIVER(state, AHEAD)[1]
    for side in (-0.4, 0.4):
        order = replace(AHEAD, arrival=Arrival((here[0] + side, here[1] + 0.4), by))
        after, frames = ARRIVER(state, order)
        assert frames.evaluations > 0
        assert after.approach.rest is not None
        turned = [target.heading - other.heading for target, other in both_targets(frames, plain)]
        assert all(math.copysign(1, side) * turn > 0.01 for turn in turned)
        assert not torch.equal(frames.motion.root_position, plain.motion.root_position)
        assert after.settings == state.settings


def both_targets(frames, others):
    return zip(frames.steering_targets, others.steering_targets, strict=True)


@pytest.mark.slow
def test_a_way_that_is_worked_out_in_slices_is_the_same():
    state, _ = begun()
    state, _ = ARRIVER(state, AHEAD)
    order = replace(AHEAD, arrival=Arrival((0.4, 0.6), state.frames / PRIOR_FPS + 0.6))
    found = []
    for seconds in (None, 0.0, 0.002, 10.0):
        now, pieces = state, []
        for _ in range(6):
            now, frames = ARRIVER(now, order, seconds=seconds)
            pieces.append(frames.motion.root_position)
        found.append(torch.cat(pieces))
    assert all(torch.equal(found[0], other) for other in found[1:])


@pytest.mark.slow
def test_a_new_order_on_the_way_plays_what_was_planned_meanwhile():
    state, _ = begun()
    state, _ = ARRIVER(state, AHEAD)
    first = replace(AHEAD, arrival=Arrival((0.4, 0.6), state.frames / PRIOR_FPS + 0.7))
    for _ in range(2):
        state, _ = ARRIVER(state, first)
    on, undisturbed = ARRIVER(state, first)
    place = (0.1, 0.7)
    second = replace(AHEAD, arrival=Arrival(place, state.frames / PRIOR_FPS + 0.7))
    now, frames = ARRIVER(state, second)
    assert torch.equal(frames.motion.root_position, undisturbed.motion.root_position)
    while now.approach.rest is not None or len(now.approach.planned):
        now, frames = ARRIVER(now, second)
    assert math.dist(frames.motion.root_position[-1, ::2].tolist(), place) < 1e-3
    assert on.frames < now.frames


def test_nobody_hurries_for_what_was_forecast():
    """Behind the character and as fast as it can: nothing is shown first that leads the other way."""
    state, _ = begun()
    for _ in range(3):
        state, _ = ARRIVER(state, AHEAD)
    here, most = state.committed.place.position_xz.tolist(), state.prior.limits.max_steering_speed
    frames = 8
    place = (here[0], here[1] - 0.97 * most * frames / PRIOR_FPS)
    order = replace(AHEAD, arrival=Arrival(place, (state.frames - 1 + frames) / PRIOR_FPS))
    after, shown = ARRIVER(state, order)
    assert shown.refusal is None
    assert after.approach.rest is None  # all of it is planned already
    speeds = torch.cat([shown.motion.root_position[:, ::2]]).diff(dim=0).norm(dim=-1) * PRIOR_FPS
    assert float(speeds.mean()) < 2 * most
