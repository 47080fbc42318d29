"""The step-length term against a walk whose steps are known, and touch-downs that are drawn by hand."""

import pytest
import torch
from helpers import walk

from mapctl.features import encode
from mapctl.terms import StepLength
from mapctl.terms.trial import Trial


def trial(contacts, *, before=None, contacts_before=(False, False)) -> Trial:
    motion = walk(len(contacts) + 1)
    features, start = encode(motion)
    joints = motion.joint_positions()
    past = joints[:0] if before is None else joints[:1]
    return Trial(
        features[1:].unsqueeze(0),
        start,
        contacts=torch.tensor(contacts).unsqueeze(0).bool(),
        before=past,
        contacts_before=torch.tensor(contacts_before),
    )


def toes(of: Trial, frame: int, foot: int):
    return of.joints_world[0, frame, of.skeleton.index(("leftToes", "rightToes")[foot])][::2]


def test_it_counts_touch_downs_from_where_the_other_foot_last_stood():
    bits = [(1, 0), (1, 0), (0, 0), (0, 1), (0, 1), (1, 1), (1, 0)]
    of = trial(bits)
    missed = StepLength(0.5, sigma=0.1).residual(of)[0]
    first = (toes(of, 3, 1) - toes(of, 1, 0)).norm()
    second = (toes(of, 5, 0) - toes(of, 5, 1)).norm()
    expected = torch.zeros(7).double()
    expected[3], expected[5] = (first - 0.5).abs(), (second - 0.5).abs()
    torch.testing.assert_close(missed.double(), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        StepLength(0.5, sigma=0.1)(of)[0].double(), 0.5 * (expected / 0.1).square(), atol=1e-3, rtol=0
    )


def test_a_foot_that_stood_just_before_the_window_counts_and_earlier_ones_do_not():
    bits = [(0, 1), (0, 1)]
    assert StepLength(0.5).residual(trial(bits)).abs().max() == 0
    stood = trial(bits, before=True, contacts_before=(True, False))
    index = stood.skeleton.index("leftToes")
    apart = (toes(stood, 0, 1) - stood.before[-1, index, ::2]).norm()
    assert float(StepLength(0.5).residual(stood)[0, 0]) == pytest.approx(abs(float(apart) - 0.5), abs=1e-5)
