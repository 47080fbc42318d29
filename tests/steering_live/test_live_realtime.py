"""A character that does not keep up: noticed within a second, told with numbers, over after two seconds in time."""

import numpy as np
import pytest

from mapctl.runtime.live_protocol import FrameChunk
from scenes.live.realtime import RealtimeMonitor


def step(seconds: float, *, spare: float = 0.03, evaluations: int = 14) -> FrameChunk:
    """Three frames of a stream."""
    three = np.zeros((3, 3))
    return FrameChunk(
        0.0,
        seconds,
        three,
        np.zeros((3, 21, 4)),
        np.zeros((3, 2)),
        np.zeros((0, 21, 3)),
        (0.0, 1.0),
        {},
        spare,
        0.05,
        evaluations,
    )


def played(
    pace: RealtimeMonitor, *, begin: float, until: float, every: float = 0.1, spare: float = 0.03
) -> list[float]:
    """Steps that come at an interval; the times at which the judgement changed, looked at four times a second."""
    changes, steps, looks = [], np.arange(begin, until, every), np.arange(begin, until, 0.25) + 0.01
    for now in np.sort(np.concatenate([steps, looks])).tolist():
        if now in steps:
            pace.add(now, step(now, spare=spare, evaluations=14 if spare > 0 else 6))
        elif pace.judge(now):
            changes.append(now)
    return changes


def test_who_keeps_up_is_never_called_slow():
    pace = RealtimeMonitor()
    assert not pace.judge(0.0)
    assert played(pace, begin=0.0, until=20.0) == []
    assert not pace.slow


@pytest.mark.parametrize("every", [0.1, 0.15, 0.3, 0.6])
def test_too_slow_is_noticed_within_a_second_and_over_when_it_is_over(every):
    pace = RealtimeMonitor()
    played(pace, begin=0.0, until=10.0)
    [noticed] = played(pace, begin=10.0, until=16.0, every=every, spare=-0.1)
    assert pace.slow
    assert noticed - 10.0 <= 1.0
    assert "100 % of its frames come late, 6 evaluations a step" in pace.text(16.0)
    [over] = played(pace, begin=16.0, until=24.0)
    assert 2.0 - every <= over - 16.0 <= 2.5
    assert not pace.slow


def test_half_the_pace_is_told_as_such():
    pace = RealtimeMonitor()
    for k in range(40):
        pace.add(0.2 * k, step(0.1 * k, spare=-0.1, evaluations=6))
    assert pace.judge(7.9)
    assert pace.text(7.9) == "it plays at 50 % of real time, 100 % of its frames come late, 6 evaluations a step"


def test_one_hiccup_is_none_of_it_and_one_in_five_is():
    pace = RealtimeMonitor()
    played(pace, begin=0.0, until=5.0)
    pace.add(5.2, step(5.0, spare=-0.1))
    assert not pace.judge(5.2)
    assert played(pace, begin=5.3, until=12.0) == []
    judged = False
    for k in range(60):
        pace.add(12 + k / 10, step(12 + k / 10, spare=-0.1 if k % 4 == 0 else 0.03))
        judged |= pace.judge(12 + k / 10)
    assert judged
    assert pace.slow


def test_silence_is_noticed_too_but_not_in_a_pause():
    pace = RealtimeMonitor()
    played(pace, begin=0.0, until=3.0)
    assert not pace.judge(3.5)
    assert pace.judge(3.9)
    assert pace.text(5.9) == "no frame for 3 s"
    pace.forget()
    assert not pace.judge(60.0)
