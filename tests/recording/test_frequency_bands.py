"""Recordings at other rates than the prior's: the slow band goes through the prior, of the fast one motion stays."""

import math
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from captures import DEGREE, apart_deg, shaken, trembling, vectors
from helpers import generator, quat_xyzw

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.frequency_bands import FrequencyBands, split_bands
from mapctl.skeleton import CANONICAL

JOINTS = CANONICAL.num_joints
NONE = torch.zeros(JOINTS, dtype=torch.float64)


def recording(fps: int | Fraction, seconds: float = 4.0, *, tremble_hz: float = 0.0) -> Motion:
    """Slow sines; about one axis of the head a fast one of 4 degrees."""
    frames = round(seconds * float(fps))
    turns = vectors(frames, JOINTS, fps=float(fps))
    time = torch.arange(frames, dtype=torch.float64) / float(fps)
    if tremble_hz:
        turns[:, CANONICAL.index("head"), 0] += 4 * DEGREE * torch.sin(2 * math.pi * tremble_hz * time)
    root = torch.stack([1.2 * time, 0.9 + 0.02 * torch.sin(11 * time), 0.1 * torch.cos(3 * time)], dim=-1)
    quats = rotations.make_sign_continuous(quat_xyzw(turns))
    return Motion(CANONICAL, Fraction(fps), root, quats)


def unchanged(bands: FrequencyBands, sigma=NONE, sigma_root=0.0) -> Motion:
    """Joined with what was shown."""
    shown = bands.at_prior_rate()
    return bands.recombine(shown, shown, sigma, sigma_root)


@pytest.mark.parametrize("fps", [24, 30, 31, 60, 120])
def test_a_recording_without_noise_of_which_nothing_is_changed_comes_back(fps):
    motion = recording(fps, tremble_hz=20.0 if fps > 60 else 0.0)
    again = unchanged(split_bands(motion))
    assert (again.skeleton, again.fps, again.num_frames) == (motion.skeleton, motion.fps, motion.num_frames)
    assert apart_deg(motion.local_quat_xyzw, again.local_quat_xyzw).max() < 1e-6
    assert (again.root_position - motion.root_position).abs().max() < 1e-6


@pytest.mark.parametrize("fps", [24, 29, Fraction(30000, 1001), 30, 60, 100, 120])
@pytest.mark.parametrize("frames", [1, 2, 3, 50, 51, 52, 53])
def test_what_the_prior_is_shown_reaches_to_the_end_and_no_further_than_it_must(fps, frames):
    bands = split_bands(recording(fps).slice(0, frames))
    end = Fraction(frames - 1) / Fraction(fps) * 30
    assert end <= bands.at_prior_rate().num_frames - 1 < end + 1
    assert bands.within - 1 <= end < bands.within
    assert bands.exact == (fps == 30)


@pytest.mark.parametrize("fps", [Fraction(1, 2), 10, 24, Fraction(30000, 1001), 30])
def test_at_the_priors_rate_or_less_everything_is_slow(fps):
    motion = recording(fps, 6.0)
    bands = split_bands(motion)
    assert bands.whole
    assert torch.equal(bands.slow.local_quat_xyzw, motion.local_quat_xyzw)
    assert torch.equal(bands.slow.root_position, motion.root_position)
    assert not bands.fast_angles.any()
    assert not bands.fast_root.any()
    assert float(bands.noise_at_prior_rate(torch.tensor(2.0))) == 2.0


def test_the_bands_part_slow_from_fast():
    head = CANONICAL.index("head")
    bands = split_bands(recording(120, tremble_hz=20.0))
    middle = slice(24, -24)
    assert not bands.whole
    fast = torch.rad2deg(bands.fast_angles[middle].norm(dim=-1))
    assert fast[:, head].max() == pytest.approx(4 * math.sin(math.pi / 3), rel=0.05)  # six frames a swing
    fast[:, head] = 0
    assert fast.max() < 0.05
    slow = recording(120)
    assert apart_deg(bands.slow.local_quat_xyzw, slow.local_quat_xyzw)[middle].max() < 0.2
    assert (bands.slow.root_position - slow.root_position).norm(dim=-1)[middle].max() < 0.001


def test_the_noise_that_the_prior_is_told_is_that_which_the_slow_band_has():
    """Of white noise at 120 fps a sixth of the power is below the edge, a third of all at 30 fps is above it."""
    still = replace(
        recording(120, 30.0), local_quat_xyzw=torch.tensor([0.0, 0, 0, 1.0]).double().expand(3600, JOINTS, 4)
    )
    bands = split_bands(trembling(still, 3 * DEGREE))
    spread = torch.rad2deg(rotations.to_rotation_vector(bands.slow.local_quat_xyzw).std(dim=0)).mean()
    assert float(spread) == pytest.approx(3 * math.sqrt(1 / 6), rel=0.1)
    told = bands.noise_at_prior_rate(torch.tensor(3.0))
    assert float(told) * math.sqrt(2 / 3) == pytest.approx(float(spread), rel=0.1)


def test_fast_noise_goes_away():
    motion = recording(120, 8.0)
    noisy = replace(
        motion,
        local_quat_xyzw=shaken(motion.local_quat_xyzw, 3 * DEGREE),
        root_position=motion.root_position + 0.02 * torch.randn(960, 3, generator=generator(1)).double(),
    )
    bands = split_bands(noisy)
    out = unchanged(bands, NONE + 3 * DEGREE, 0.02)
    rest = rotations.multiply(rotations.inverse(bands.slow.local_quat_xyzw), out.local_quat_xyzw)
    left = rotations.to_rotation_vector(rest).square().mean().sqrt()
    assert left < 0.1 * bands.fast_angles.square().mean().sqrt()
    assert (out.root_position - bands.slow.root_position).square().mean() < 0.01 * bands.fast_root.square().mean()


def test_a_kick_far_above_the_noise_survives_and_only_while_it_lasts():
    motion, joint = recording(120, 8.0), CANONICAL.index("rightLowerLeg")
    time = torch.arange(960, dtype=torch.float64) / 120
    burst = 25 * DEGREE * torch.sin(2 * math.pi * 18 * time) * torch.exp(-0.5 * ((time - 4) / 0.06).square())
    turns = torch.zeros(960, JOINTS, 3, dtype=torch.float64)
    turns[:, joint, 0] = burst
    kicked = rotations.multiply(motion.local_quat_xyzw, rotations.from_rotation_vector(turns))
    noisy = replace(motion, local_quat_xyzw=rotations.make_sign_continuous(shaken(kicked, DEGREE)))
    out = unchanged(split_bands(noisy), NONE + DEGREE)
    away = apart_deg(out.local_quat_xyzw, kicked)
    during = (time - 4).abs() < 0.08
    assert away[during, joint].mean() < 2.5
    assert away[~during].mean() < 1.6  # what noise the slow band has
    assert away[:, joint].max() < 8


def test_a_change_at_the_priors_rate_is_carried_back_smoothly():
    motion, joint = recording(120), CANONICAL.index("leftUpperArm")
    bands = split_bands(motion)
    shown = bands.at_prior_rate()
    time = torch.arange(shown.num_frames, dtype=torch.float64) / 30
    turns = torch.zeros(shown.num_frames, JOINTS, 3, dtype=torch.float64)
    turns[:, joint, 2] = 0.2 * torch.sin(2 * math.pi * time)
    cleaned = replace(
        shown,
        root_position=shown.root_position + 0.05 * torch.sin(4 * time)[:, None],
        local_quat_xyzw=rotations.multiply(shown.local_quat_xyzw, rotations.from_rotation_vector(turns)),
    )
    out = bands.recombine(shown, cleaned, NONE, 0.0)
    wanted = torch.arange(motion.num_frames, dtype=torch.float64) / 120
    inside = wanted <= time[-1]
    turned = rotations.to_rotation_vector(
        rotations.multiply(rotations.inverse(motion.local_quat_xyzw), out.local_quat_xyzw)
    )
    assert (turned[inside, joint, 2] - 0.2 * torch.sin(2 * math.pi * wanted[inside])).abs().max() < 1e-3
    moved = out.root_position - motion.root_position
    assert (moved[inside] - 0.05 * torch.sin(4 * wanted[inside])[:, None]).abs().max() < 1e-4
    turned[:, joint] = 0
    assert turned.abs().max() < 1e-6


@pytest.mark.parametrize("frames", [1, 2, 5, 17, 18, 40])
def test_short_recordings_come_back_too(frames):
    motion = recording(120).slice(0, frames)
    again = unchanged(split_bands(motion))
    assert again.num_frames == frames
    assert apart_deg(motion.local_quat_xyzw, again.local_quat_xyzw).max() < 1e-5


def test_the_ends_of_a_noisy_recording_are_no_noisier_than_the_rest():
    """A filter that begins at the first frame itself would take its noise for motion."""
    motion = recording(120, 2.0)
    first, rest = [], []
    for seed in range(12):
        noisy = trembling(motion, 3 * DEGREE, seed=seed)
        away = apart_deg(split_bands(noisy).slow.local_quat_xyzw, motion.local_quat_xyzw)
        first.append(away[0].mean())
        rest.append(away[60:-60].mean())
    assert torch.stack(first).mean() < 2 * torch.stack(rest).mean()
