"""Denoising as a live capture needs it: nothing that comes later changes what was given."""

import math
from dataclasses import replace

import pytest
import torch
from captures import error_cm, noisy, on_rig, shaken
from tiny_denoiser import QUICK, tiny_denoiser

from controllers.common.map_refinement import RefinementSettings
from controllers.denoising.causal import CausalDenoiser, denoise_causal
from mapctl.motion import Motion
from mapctl.recording.masks import Mask
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings

RATES = (("bandai", 24), ("bandai", 30), ("daz", 50), ("canonical", 60), ("daz", 120))
FAST = replace(
    QUICK, refinement=RefinementSettings(lbfgs=LbfgsSettings(max_iterations=1), budget=Budget(evaluations=1))
)


def stream(delay=0.2, past=0.6):
    return CausalDenoiser(tiny_denoiser(), settings=FAST, delay=delay, past=past)


def pushed(motion: Motion, at_once: int = 1, **causal):
    """Results of each push with the number of frames so far; the last is that of finish."""
    source, given = stream(**causal), []
    for first in range(0, motion.num_frames, at_once):
        stop = min(first + at_once, motion.num_frames)
        done = source.push(motion.slice(first, stop))
        if done is not None:
            given.append((done, stop))
    rest = source.finish()
    assert source.finish() is None or rest is None
    return given, rest


@pytest.mark.parametrize(
    ("rig", "fps", "delay"),
    [
        ("daz", 50, 0.2),
        *(pytest.param(*case, 0.1, marks=pytest.mark.slow) for case in RATES),
        *(pytest.param(*case, 0.2, marks=pytest.mark.slow) for case in RATES if case != ("daz", 50)),
    ],
)
def test_all_frames_come_back_once_and_within_the_delay(rig, fps, delay):
    motion = noisy(on_rig(rig, round(0.7 * fps), fps=fps))
    given, rest = pushed(motion, delay=delay, past=0.3)
    count = 0
    for done, come in given:
        assert (come - 1 - count) / fps <= delay + 1e-9  # the oldest of them came that long before the newest
        count += done.motion.num_frames
        assert done.motion.skeleton is motion.skeleton
        # No frame may wait longer than is said, and none is decided without what may come within half of it.
        assert (come - count) / fps <= delay
        assert come - count >= math.floor(delay / 2 * fps) - 1
    assert count + rest.motion.num_frames == motion.num_frames
    captured = torch.cat([done.capture.local_quat_xyzw for done in [*(d for d, _ in given), rest]])
    assert torch.equal(captured, motion.local_quat_xyzw)


@pytest.mark.slow
def test_what_comes_after_the_delay_changes_nothing_that_was_given():
    motion = noisy(on_rig("daz", 54))
    quats, root = motion.local_quat_xyzw.clone(), motion.root_position.clone()
    quats[40:] = shaken(quats, 2.0, seed=7)[40:]
    root[40:] += 3
    other = replace(motion, local_quat_xyzw=quats, root_position=root)
    first, second = (pushed(one, 4)[0] for one in (motion, other))
    count = 0
    for (mine, come), (theirs, _) in zip(first, second, strict=True):
        if come > 40:
            break
        count += mine.motion.num_frames
        assert torch.equal(mine.motion.local_quat_xyzw, theirs.motion.local_quat_xyzw)
        assert torch.equal(mine.motion.root_position, theirs.motion.root_position)
    assert count >= 40 - 0.3 * 30 - 4


@pytest.mark.slow
def test_the_noise_shrinks_and_passes_meet_without_a_jump():
    truth = on_rig("canonical", 45)
    given = noisy(truth)
    calls = []
    done = denoise_causal(
        given, tiny_denoiser(), settings=FAST, delay=0.3, progress=lambda now, of: calls.append((now, of))
    )
    assert (done.motion.num_frames, done.capture.num_frames, len(done.contacts)) == (45, 45, 45)
    assert error_cm(truth, done.motion) < 0.85 * error_cm(truth, given)
    jump, before = (torch.diff(m.joint_positions(), n=2, dim=0).norm(dim=-1)[10:].max() for m in (done.motion, given))
    assert jump < 0.5 * before
    assert "causal: a frame is decided at most 0.30 s after it came" in done.notes
    assert calls
    assert all(now <= of == 45 for now, of in calls)


@pytest.mark.parametrize("frames", [1, 7])
def test_a_capture_that_is_over_at_once_comes_back(frames):
    motion = noisy(on_rig("bandai", 20)).slice(0, frames)
    assert denoise_causal(motion, tiny_denoiser(), settings=FAST).motion.num_frames == frames


@pytest.mark.slow
def test_masks_count_from_the_first_frame_of_all():
    truth = on_rig("daz", 60)
    given = noisy(truth, 1.0, 0.3)
    arm = truth.skeleton.index("lForeArm")
    quats = given.local_quat_xyzw.clone()
    quats[40:44, arm] = shaken(quats, 2.0, seed=4)[40:44, arm]
    wild = replace(given, local_quat_xyzw=quats)
    done = denoise_causal(wild, tiny_denoiser(), settings=FAST, masks=[Mask("lForeArm", 40, 44)], delay=0.3)
    hand = truth.skeleton.index("lHand")
    away = (done.motion.joint_positions() - truth.joint_positions())[40:44, hand].norm(dim=-1)
    assert away.max() < 0.1
    dropouts = {(fault.start, fault.stop) for fault in done.faults if fault.kind == "dropout"}
    assert min(start for start, _ in dropouts) == 40
    assert max(stop for _, stop in dropouts) == 44


@pytest.mark.parametrize("fps", [24, 29.97, 120])
@pytest.mark.parametrize("delay", [1 / 30, 0.2])
def test_the_stated_delay_holds_at_any_rate(fps, delay):
    most, step = stream(delay).compute_delay_frames(fps)
    assert most / fps <= delay + 1e-9 < (most + 1) / fps + 1e-9
    assert step >= 1
    assert step / fps <= max(delay / 2, 1 / fps) + 0.5 / fps
