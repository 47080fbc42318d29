"""Suggested timing: what it depends on, what it does not, and what the fit and the bench make of pairs of poses."""

from dataclasses import replace

import pytest
import torch
from helpers import moved, random_motion, walk

import priors
from controllers.inbetweening import keyframes
from mapctl.intent.keyframes import Keys
from mapctl.recording.masks import MissingMask, restore_observed

KEYS = Keys((0, 20, 50, 89))


def suggest_intervals(motion, keys):
    return keyframes.suggest_intervals(motion, keys, priors.load_keyframe_timing().estimate_seconds)


def frames(intervals):
    return [(interval.start, interval.stop, interval.suggested) for interval in intervals]


def shifted_from(motion, frame, metres):
    """All frames from this one on moved ahead."""
    root = motion.root_position.clone()
    root[frame:, 2] += metres
    return replace(motion, root_position=root)


def test_position_in_the_world_and_frames_between_the_keys_change_nothing():
    motion = walk(90, turn_rate=0.3)
    found = frames(suggest_intervals(motion, KEYS))
    assert frames(suggest_intervals(moved(motion, turn=2.0, shift=(5.0, -3.0)), KEYS)) == found
    free = torch.ones(90, dtype=torch.bool)
    free[list(KEYS.frames)] = False
    lost = MissingMask.of_frames(free, motion.num_joints)
    assert frames(suggest_intervals(restore_observed(random_motion(motion.skeleton, 90), motion, lost), KEYS)) == found


def test_farther_takes_longer_and_very_far_goes_on_at_one_speed():
    motion = walk(60)
    found = [
        suggest_intervals(shifted_from(motion, 30, metres), Keys((0, 30)))[0] for metres in (0.0, 1.0, 2.0, 8.0, 20.0)
    ]
    taken = [interval.suggested for interval in found]
    assert taken == sorted(set(taken))
    assert found[-1].suggested_speed == pytest.approx(found[-2].suggested_speed, rel=0.05)


@pytest.mark.parametrize(("metres", "verdict"), [(6.0, "short: 7."), (0.0, "usual: 1."), (-0.9, "long: 0.3")])
def test_a_timing_that_nobody_would_take_is_named_with_numbers(metres, verdict):
    (interval,) = suggest_intervals(shifted_from(walk(40), 31, metres), Keys((0, 31)))
    assert interval.reason.startswith(verdict)
    assert f"mocap mostly takes {interval.usual[0]} to {interval.usual[1]} frames" in interval.reason
    assert interval.given_speed == pytest.approx(interval.metres * 30 / 31)
