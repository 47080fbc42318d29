"""Contacts: the definition against a plain loop, and what must not change them."""

import numpy as np
import pytest
import torch

from mapctl.contacts import detect_contacts
from mapctl.errors import RequestError


def steps(frames, fps, seed=0):
    """Two toes that stand 0.6 s and swing 0.4 s in turn, with a little noise; metres."""
    rng, time = np.random.default_rng(seed), np.arange(frames) / fps
    toes = np.zeros((frames, 2, 3))
    for foot, phase in enumerate((0.0, 0.5)):
        cycle, part = np.divmod(time + phase, 1.0)
        swing = np.clip((part - 0.6) / 0.4, 0, 1)
        toes[:, foot, 2] = 1.2 * (cycle + (1 - np.cos(np.pi * swing)) / 2)
        toes[:, foot, 1] = 0.02 + 0.1 * np.sin(np.pi * swing)
    return toes + rng.normal(size=toes.shape) * 0.0005


def by_loop(toes, fps, run=3):
    """The definition, frame by frame, for 30 fps; the first frame is left out."""
    out = np.zeros((len(toes) - 1, 2), bool)
    for foot in range(2):
        floor = np.percentile(toes[:, foot, 1], 5)
        stands = [
            toes[t, foot, 1] < floor + 0.025 and np.hypot(*(toes[t, foot, ::2] - toes[t - 1, foot, ::2])) * fps < 0.35
            for t in range(1, len(toes))
        ]
        start = 0
        for t in range(len(stands) + 1):
            if t == len(stands) or not stands[t]:
                out[start:t, foot] = t - start >= run
                start = t + 1
    return out


@pytest.mark.parametrize("seed", range(2))
def test_contacts_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    for toes in (steps(150, 30, seed), rng.normal(size=(200, 2, 3)) * [0.004, 0.02, 0.004]):
        expected = by_loop(toes, 30)
        assert expected.any()
        assert not expected.all()
        np.testing.assert_array_equal(detect_contacts(toes, 30)[1:].numpy(), expected)


def test_contacts_mean_the_same_at_any_frame_rate():
    slow, fast = detect_contacts(steps(180, 30), 30), detect_contacts(steps(720, 120), 120)
    assert (slow == fast[::4]).double().mean() > 0.97


def test_contacts_shorter_than_a_tenth_of_a_second_are_dropped():
    for frames, kept in ((2, False), (3, True)):
        toes = torch.zeros(30, 1, 3, dtype=torch.float64)
        toes[:, 0, 0] = torch.arange(30)
        toes[11 : 11 + frames, 0, 0] = 10.0  # stands for so many steps
        assert bool(detect_contacts(toes, 30).any()) is kept


def test_the_first_frame_is_planted_with_the_second():
    still = torch.zeros(10, 2, 3)
    assert detect_contacts(still, 30).all()
    still[0, 0, 1] = 0.1  # the left toe starts in the air
    assert detect_contacts(still, 30)[0].tolist() == [False, True]


@pytest.mark.parametrize(("shape", "fps"), [((0, 2, 3), 30), ((5, 2, 3), float("nan"))])
def test_no_frames_and_no_frame_rate_are_refused(shape, fps):
    with pytest.raises(RequestError):
        detect_contacts(torch.zeros(shape), fps)
