"""Noise that lasts beyond a frame: found beside a proposal, told from motion that the model missed, not put back."""

import math

import pytest
import torch
from captures import DEGREE
from helpers import generator
from scipy.signal import butter, lfilter, sosfiltfilt

from mapctl.recording.lasting_noise import find_lasting_noise
from mapctl.recording.noise_estimation import _estimate_sigma
from mapctl.recording.residual_motion import restore_residual_motion

FRAMES, JOINTS = 300, 12


def white(degrees: float = 5.0, frames: int = FRAMES) -> torch.Tensor:
    return degrees * DEGREE * torch.randn(frames, JOINTS, 3, generator=generator(), dtype=torch.float64)


def lasting(keep: float, degrees: float = 5.0, frames: int = FRAMES) -> torch.Tensor:
    scaled = math.sqrt(1 - keep * keep) * white(degrees, frames + 100).numpy()
    return torch.as_tensor(lfilter([1.0], [1.0, -keep], scaled, axis=0)[100:].copy())


def filtered(hertz: float, degrees: float = 5.0) -> torch.Tensor:
    sections = butter(2, hertz / 15, output="sos")
    return torch.as_tensor(sosfiltfilt(sections, white(degrees).numpy(), axis=0).copy())


def missed(degrees: float = 10.0, joints: slice = slice(None), size: float = 20.0) -> torch.Tensor:
    """Motion of some joints about one moment."""
    time = torch.arange(FRAMES, dtype=torch.float64)
    burst = degrees * DEGREE * torch.exp(-0.5 * ((time - 150) / size).square())
    rest = torch.zeros(FRAMES, JOINTS, 3, dtype=torch.float64)
    rest[:, joints] = burst[:, None, None]
    return rest


def swaying_apart(degrees: float) -> torch.Tensor:
    """Motion that a weak model misses throughout: of every joint, slow in some and quick in others."""
    time = torch.arange(FRAMES, dtype=torch.float64)[:, None, None] / 30
    hertz = torch.linspace(0.4, 5.0, JOINTS, dtype=torch.float64)[None, :, None]
    phase = 6.3 * torch.rand(1, JOINTS, 3, generator=generator(2), dtype=torch.float64)
    return degrees * DEGREE * math.sqrt(2) * torch.sin(2 * math.pi * hertz * time + phase)


def swelling() -> torch.Tensor:
    """Louder and quieter by turns, by a factor of five."""
    time = torch.arange(FRAMES, dtype=torch.float64)[:, None, None]
    return torch.exp(0.8 * torch.sin(2 * math.pi * time / 150))


def find(rest: torch.Tensor, seen: torch.Tensor | None = None):
    """As of a capture of somebody who stands still and of whom a model misses nothing."""
    seen = torch.ones(rest.shape[:2], dtype=torch.bool) if seen is None else seen
    return find_lasting_noise(rest, seen, _estimate_sigma(rest, seen, differenced=0))


@pytest.mark.parametrize("keep", [0.5, 0.72, 0.9])
def test_its_size_and_how_long_it_lasts_are_found(keep):
    rest = lasting(keep)
    estimated = _estimate_sigma(rest, torch.ones(rest.shape[:2], dtype=torch.bool), differenced=0)
    found = find(rest)
    assert float((found.factor * estimated).median() / DEGREE) == pytest.approx(5, rel=0.15)
    assert float(estimated.median() / DEGREE) < 4
    assert found.correlation[:4].tolist() == pytest.approx([keep**lag for lag in range(4)], abs=0.12)


@pytest.mark.parametrize("hertz", [3, 6])
def test_noise_of_a_capture_that_was_filtered_before_is_found(hertz):
    rest = filtered(hertz)
    estimated = _estimate_sigma(rest, torch.ones(rest.shape[:2], dtype=torch.bool), differenced=0)
    found = find(rest)
    size = float(rest.square().mean().sqrt())
    assert float((found.factor * estimated).median()) == pytest.approx(size, rel=0.15)
    assert float(estimated.median()) < 0.3 * size


@pytest.mark.parametrize(
    "rest",
    [
        white(),
        white(0.0),
        white() + missed(),
        white() + missed(joints=slice(0, 8), size=60.0),
        white(0.3) + missed(20.0, joints=slice(0, 3), size=200.0),
        lasting(0.72, degrees=0.2),
        lasting(0.72, frames=40),
        filtered(6, degrees=0.3),
        white(0.7) + swaying_apart(1.0),
        white(2.0) + swaying_apart(1.7),
        lasting(0.25),
        lasting(0.48, degrees=1.5),
        torch.where(torch.arange(JOINTS)[:, None] % 2 == 0, lasting(0.6), lasting(0.95)),
        swelling() * filtered(3),
    ],
    ids=[
        "white",
        "none",
        "a moment",
        "some joints",
        "few joints",
        "little",
        "short",
        "little, filtered",
        "all joints",
        "all joints of a noisy capture",
        "nearly white",
        "little that is near it",
        "uneven",
        "comes and goes",
    ],
)
def test_white_noise_motion_that_was_missed_and_what_is_too_little_are_none(rest):
    assert find(rest) is None


@pytest.mark.parametrize(
    ("keeps", "degrees", "is_found"),
    [((0.62, 0.78), 0.45, True), ((0.62, 0.78), 1.5, False), ((0.62, 0.78), 5.0, True), ((0.86, 0.91), 2.0, True)],
    ids=["as after a filter", "little", "much", "many times the estimate"],
)
def test_joints_that_differ_a_little_are_taken_for_motion_where_noise_may_be_what_a_model_misses(
    keeps, degrees, is_found
):
    odd = torch.arange(JOINTS)[:, None] % 2 == 0
    one, other = (lasting(keep, degrees) for keep in keeps)
    assert (find(torch.where(odd, one, other)) is not None) == is_found


@pytest.mark.parametrize("degrees", [1.5, 2.5])
def test_more_is_looked_for_more_readily_where_some_was_found(degrees):
    rest, seen = lasting(0.72, degrees), torch.ones(FRAMES, JOINTS, dtype=torch.bool)
    told = find(rest).factor * _estimate_sigma(rest, seen, differenced=0)
    assert find_lasting_noise(rest, seen, told, again=True) is None
    assert find_lasting_noise(rest, seen, told / 1.3) is None
    found = find_lasting_noise(rest, seen, told / 1.3, again=True)
    assert float(found.factor.median()) == pytest.approx(1.3, rel=0.1)
    unlike = white(0.7) + swaying_apart(1.0)
    assert find(unlike) is None
    assert find_lasting_noise(unlike, seen, told * 0.3, again=True)


def test_a_joint_that_misses_motion_besides_is_not_taken_for_much_louder():
    rest = lasting(0.72)
    rest[:, 3] += 1.0 * torch.sin(torch.arange(FRAMES, dtype=torch.float64) / 5)[:, None]
    found = find(rest)
    assert float(found.factor[3]) <= 2 * float(found.factor.median())


def test_what_was_not_seen_says_nothing():
    rest, seen = lasting(0.72), torch.ones(FRAMES, JOINTS, dtype=torch.bool)
    seen[40:90, 2], seen[:, 7] = False, False
    wild = torch.where(seen[..., None], rest, 50.0)
    sigma = torch.full((JOINTS,), 2 * DEGREE, dtype=torch.float64)
    one, other = find_lasting_noise(rest, seen, sigma), find_lasting_noise(wild, seen, sigma)
    assert torch.equal(one.factor, other.factor)
    assert torch.equal(one.correlation, other.correlation)
    assert float(one.factor[7]) == 1


def test_of_noise_that_lasts_little_goes_back_where_its_correlation_is_known():
    rest, seen = lasting(0.72), torch.ones(FRAMES, JOINTS, dtype=torch.bool)
    sigma = torch.full((JOINTS,), 5 * DEGREE, dtype=torch.float64)
    correlation = 0.72 ** torch.arange(18, dtype=torch.float64)
    back, share = restore_residual_motion(rest, seen, sigma, correlation)
    assert float(share.mean()) < 0.1
    assert back.square().mean() < 0.05 * rest.square().mean()
    assert float(restore_residual_motion(rest, seen, sigma)[1].mean()) > 0.8  # as if it were white
    motion = missed(60.0)
    back, _ = restore_residual_motion(rest + motion, seen, sigma, correlation)
    at = slice(140, 160)
    assert (back - motion)[at].square().mean() < 0.2 * motion[at].square().mean()
