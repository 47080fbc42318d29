"""Orders to be somewhere at a time, with an untrained density and stitcher: exact, and steered on from there."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_steering import AHEAD, begun
from tiny_stitcher import tiny_stitcher

from controllers.steering.arrival import Arriver
from controllers.steering.loop import Recorder, StreamClock, drive
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Arrival, CommandTrack
from mapctl.metrics.travel import measure_arrivals
from mapctl.retarget import to_canonical

ARRIVER = Arriver(tiny_stitcher())  # 23 frames between two poses at most


def play(*orders, frames=70, state=None):
    """Play orders at their times, after a start ahead; returns the recorder and the track."""
    track = CommandTrack(
        (0.0, *(time for time, _ in orders)), (AHEAD, *(replace(AHEAD, arrival=order) for _, order in orders))
    )
    recorder = Recorder()
    begin, first = begun() if state is None else state
    recorder.show(first, 0.0)
    drive(begin, track.at, [recorder.show], frames=frames, clock=StreamClock(), stepper=ARRIVER)
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
    assert row["position_error_cm"] < 0.1
    assert facing is None or row["facing_error_deg"] < 0.1


@pytest.mark.slow
def test_a_far_place_is_walked_to_first_and_steered_from_there():
    recorder, track = play((0.2, Arrival((0.3, 1.5), 2.0, 0.5)), frames=80)
    assert errors(recorder, track)["position_error_cm"] < 0.1
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
    assert row["position_error_cm"] < 0.1


@pytest.mark.slow
def test_what_nobody_can_is_refused_once_with_numbers_and_changes_nothing():
    recorder, track = play((0.2, Arrival((50.0, 0.0), 0.9)), (0.5, Arrival((0.0, 0.0), 0.5)))
    printed = [refusal.reason for refusal in recorder.refusals]
    assert len(printed) == 2
    assert "50.0 m away, in 0.6 s is not obeyed: it needs 8" in printed[0]
    assert "the shortest takes" in printed[1]
    assert measure_arrivals(recorder.motion(), track, [refusal.order for refusal in recorder.refusals]) == []
    plain, _ = play()
    assert torch.equal(recorder.motion().root_position, plain.motion().root_position)


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
    position = (0.1, 0.7)
    second = replace(AHEAD, arrival=Arrival(position, state.frames / PRIOR_FPS + 0.7))
    now, frames = ARRIVER(state, second)
    assert torch.equal(frames.motion.root_position, undisturbed.motion.root_position)
    while now.approach.rest is not None or len(now.approach.planned):
        now, frames = ARRIVER(now, second)
    assert math.dist(frames.motion.root_position[-1, ::2].tolist(), position) < 1e-3
    assert on.frames < now.frames
