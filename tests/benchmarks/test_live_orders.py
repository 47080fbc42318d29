"""The bench of live orders: what it counts, and when it says nothing."""

import math

import numpy as np
import pytest
import torch

from controllers.benchmarks.live_orders import _Log, _Order, _summarise
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.rotations import about_y
from mapctl.runtime.live_protocol import FrameChunk


def chunk(due, place, turn=0.0, evaluations=0):
    """Three frames, the last of them at a place."""
    root = np.zeros((3, 3))
    root[-1, ::2] = place
    quats = np.zeros((3, 21, 4))
    quats[..., 3] = 1.0
    quats[:, 0] = about_y(torch.tensor(turn)).numpy()
    return FrameChunk(
        due, due, root, quats, np.zeros((3, 2)), np.zeros((0, 21, 3)), (0.0, 0.0), {}, 0.1, 0.01, evaluations
    )


def test_an_order_met_to_the_frame_is_off_by_nothing():
    """Asked for a step before its first frames are due, which are solved to set out."""
    within = (10 * 3 - 1) / PRIOR_FPS + 3 / PRIOR_FPS
    order = _Order(9.85, (1.0, 2.0), 0.5, within, Command(1.0, 0.0))
    for earlier in (9.86, 9.88):  # solved before the order was read
        order.take(chunk(earlier, (0.0, 0.0), evaluations=14))
    for number in range(10):
        order.take(chunk(9.9 + number * 3 / PRIOR_FPS, (1.0, 2.0), 0.5, evaluations=6 if number == 0 else 0))
    found = order.measure()
    assert found["off_s"] == pytest.approx(0.0, abs=1e-6)
    assert found["place_cm"] == pytest.approx(0.0)
    assert found["facing_deg"] == pytest.approx(0.0, abs=1e-4)
    assert found["seen_s"] == pytest.approx(0.05)


def test_errors_are_those_of_the_last_frame_and_solved_frames_are_no_part_of_a_way():
    order = _Order(0.0, (1.0, 2.0), 0.5, 0.2, Command(1.0, 0.0))
    for each in (chunk(0.1, (0.5, 0.5)), chunk(0.2, (1.0, 2.03), 0.4), chunk(0.3, (9.0, 9.0), evaluations=7)):
        order.take(each)
    found = order.measure()
    assert found["place_cm"] == pytest.approx(3.0)
    assert found["facing_deg"] == pytest.approx(math.degrees(0.1), rel=1e-3)


def test_of_orders_that_nobody_carried_out_there_is_no_figure():
    order = _Order(0.0, (1.0, 2.0), 0.5, 0.2, Command(1.0, 0.0))
    log = _Log([order, order], [chunk(0.1 * number, (0.0, 0.1 * number), evaluations=3) for number in range(4)])
    found = _summarise(log, 0.1)
    assert (found["orders"], found["carried_out"]) == (1, 0)
    assert math.isnan(found["place_cm_most"])
