"""What a viewer sees first: the largest step and acceleration, and bodies on feet that do not carry them."""

import numpy as np
import pytest
import torch
from helpers import walk

from mapctl import contacts
from mapctl.metrics import body
from mapctl.skeleton import CANONICAL

TOES = [CANONICAL.index(name) for name in ("leftToes", "rightToes")]
HANDS = [CANONICAL.index(name) for name in ("leftHand", "rightHand")]


@pytest.mark.parametrize("fps", [30, 60])
def test_a_jump_of_one_frame_is_the_largest_step_whatever_the_body_does(fps):
    motion = walk(2 * fps, fps=fps)
    places = motion.joint_positions()
    ends = places[:, HANDS].clone()
    calm = body.measure_peaks(ends, places[:, 0], fps)
    ends[fps, 0] += torch.tensor([0.0, 0.6, 0.0]).double()
    peaks = body.measure_peaks(ends, places[:, 0], fps)
    assert peaks.step == pytest.approx(0.6 * fps / 30, abs=calm.step)
    assert peaks.acceleration == pytest.approx(1.2 * fps**2, abs=calm.acceleration)
    shifted = body.measure_peaks(
        ends + torch.arange(2 * fps)[:, None, None], places[:, 0] + torch.arange(2 * fps)[:, None], fps
    )
    assert shifted == pytest.approx(peaks)


def test_a_single_frame_has_no_peaks():
    assert body.measure_peaks(torch.zeros(1, 2, 3), torch.zeros(1, 3), 30.0) == (0.0, 0.0)


def independent(toes, hips, fps):
    """The same by the letter of the definition, frame by frame."""
    floor, best, run = np.percentile(toes[..., 1], 5, axis=0), 0, 0
    for t in range(1, len(toes)):
        speeds = [np.hypot(*(toes[t, k] - toes[t - 1, k])[[0, 2]]) * fps for k in range(2)]
        low = [toes[t, k, 1] - floor[k] for k in range(2)]
        carried = any(low[k] < 0.03 and speeds[k] < 0.35 for k in range(2))
        goes = np.hypot(*(hips[t] - hips[t - 1])[[0, 2]]) * fps > 0.3
        run = run + 1 if not carried and min(low) < 0.05 and goes else 0
        best = max(best, run)
    return best / fps


@pytest.mark.parametrize("slide", [0.0, 0.01, 0.02, 0.05])
def test_the_longest_time_unsupported_is_that_of_the_definition(slide):
    motion = walk(90)
    toes, hips = (motion.joint_positions()[:, joints].clone() for joints in (TOES, [0]))
    shift = torch.arange(90).clamp(min=30, max=70)[:, None] * torch.tensor([slide, 0.0, 0.0]).double()
    toes, hips = toes + shift[:, None], hips[:, 0] + shift
    assert body.measure_longest_unsupported(toes, hips, 30.0) == pytest.approx(
        independent(toes.numpy(), hips.numpy(), 30.0)
    )
    assert (body.measure_longest_unsupported(toes, hips, 30.0) > 0.5) == (slide > 0.005)


def test_a_body_stands_on_the_slowest_low_toe_and_on_none_in_flight():
    heights = torch.tensor([[0.0, 0.0], [0.0, 0.2], [0.3, 0.2], [0.01, 0.04]])
    speeds = torch.tensor([[1.0, 0.1], [1.0, 0.1], [1.0, 0.1], [0.7, 0.5]])
    torch.testing.assert_close(contacts.support_speed(heights, speeds), torch.tensor([0.1, 1.0, 0.0, 0.5]))
