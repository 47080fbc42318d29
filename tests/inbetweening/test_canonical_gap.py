"""The query of a clip with gaps at 30 fps: every key is shown with its own pose at its own time, or another one is."""

from dataclasses import replace

import pytest
import torch
from captures import apart_deg
from helpers import walk

from controllers.inbetweening.pipeline import CanonicalClip
from mapctl import retarget
from mapctl.inbetweening.missing import MissingMask
from mapctl.recording.masks import ROOT, Mask
from mapctl.skeleton import CANONICAL


def keyed(motion, keys, *, hips=()):
    """All is lost but whole poses, and the hips alone in some frames."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[list(keys)] = False
    joints, root = free[:, None].expand(-1, motion.num_joints).clone(), free.clone()
    joints[list(hips), 0] = False
    root[list(hips)] = False
    return MissingMask(joints, root)


def gap_of(motion, lost):
    """A canonical motion is shown as it is, whatever stands where it is lost."""
    clip = CanonicalClip.of(motion, lost)
    return replace(clip, canonical=motion).query()


def known(gap):
    """Moments of which nothing is lost."""
    return (~gap.missing.frames).nonzero()[:, 0].tolist()


@pytest.mark.parametrize(("fps", "spare"), [(10, 0), (24, 3), (50, 0), (120, 3)])
def test_times_rise_and_reach_the_end(fps, spare):
    motion = walk(fps + spare, fps=fps)
    gap = gap_of(motion, keyed(motion, (0, motion.num_frames - 1)))
    steps = torch.diff(gap.seconds)
    assert len(gap.seconds) == gap.motion.num_frames == len(gap.missing.joints) == len(gap.missing.root)
    assert 0.4 / 30 < steps.min() <= steps.max() < 1.6 / 30
    assert gap.seconds[0] == 0
    assert gap.seconds[-1] * fps == pytest.approx(motion.num_frames - 1)
    assert known(gap) == [0, gap.motion.num_frames - 1]


@pytest.mark.parametrize("fps", [10, 24, 50, 120])
def test_a_key_at_any_frame_is_one_moment_with_its_own_pose_and_time(fps):
    motion = walk(fps, fps=fps, turn_rate=0.5)
    for key in range(2 * max(1, fps // 30), fps - 2 * max(1, fps // 30), 1 + fps // 4):
        gap = gap_of(motion, keyed(motion, (0, key, fps - 1)))
        assert (torch.diff(gap.seconds) > 0).all()
        _, moment, _ = known(gap)
        assert gap.seconds[moment] * fps == pytest.approx(key)
        assert torch.equal(gap.motion.root_position[moment], motion.root_position[key])
        assert apart_deg(gap.motion.local_quat_xyzw[moment], motion.local_quat_xyzw[key]).max() < 1e-5
        assert not gap.missing.root[moment]
        assert gap.known_positions[moment].all()


def test_a_place_is_known_only_with_all_that_carries_it():
    motion = walk(30)
    _, rigmap = retarget.to_canonical(motion)
    gap = gap_of(motion, MissingMask.of_masks(motion, [Mask(ROOT, 5, 9)], rigmap))
    assert not gap.known_positions[5:9].any()
    assert gap.known_positions[9:].all()
    gap = gap_of(motion, MissingMask.of_masks(motion, [Mask("chest", 5, 9)], rigmap))
    unknown = {CANONICAL.names[joint] for joint in (~gap.known_positions[6]).nonzero()[:, 0].tolist()}
    assert {"head", "leftHand", "neck"} <= unknown
    assert not unknown & {"hips", "leftFoot", "rightToes"}
