"""Fusion of a capture and a proposal: never worse than the better of the two by much, and exact without noise."""

import math

import numpy as np
import pytest
import torch
from captures import DEGREE, apart_deg, vectors
from helpers import generator, quat_xyzw

from mapctl import rotations
from mapctl.recording.fusion import fuse_positions, fuse_rotations, smooth_columns

JOINTS, SIGMA = 4, 5 * DEGREE
LEVEL = torch.full((JOINTS,), SIGMA, dtype=torch.float64)
RATES = [60]


def truth(fps: float, seconds: float = 8.0):
    """Slow turns of a few joints (xyzw)."""
    return rotations.make_sign_continuous(quat_xyzw(vectors(round(seconds * fps), JOINTS, fps=fps)))


def shake(quats, sigma: float = SIGMA, seed: int = 0):
    noise = sigma * torch.randn(*quats.shape[:2], 3, generator=generator(seed)).double()
    return rotations.multiply(quats, rotations.from_rotation_vector(noise))


def turn(quats, degrees):
    """Turn about each joint's x axis, by frame or by a constant."""
    vector = torch.zeros(*quats.shape[:2], 3, dtype=torch.float64)
    vector[..., 0] = DEGREE * torch.as_tensor(degrees, dtype=torch.float64).expand(len(quats))[:, None]
    return rotations.multiply(quats, rotations.from_rotation_vector(vector))


def everywhere(quats):
    return torch.ones(quats.shape[:2], dtype=torch.bool)


def error(quats, wanted) -> float:
    return float(apart_deg(quats, wanted).mean())


@pytest.mark.parametrize("weight", [1.0, 0.0])
def test_the_smoother_minimises_squared_distances_and_third_differences(weight):
    frames, hertz, fps = 40, 2.0, 30.0
    values = torch.randn(frames, 2, 3, generator=generator()).double()
    weights = torch.ones(frames, 2, dtype=torch.float64)
    weights[10:14] = weight
    third = np.diff(np.eye(frames), 3, axis=0)
    stiffness = (2 * math.sin(math.pi * hertz / fps)) ** -6
    system = np.diag(weights[:, 0].numpy().clip(1e-9)) + stiffness * third.T @ third
    wanted = np.linalg.solve(system, (weights[..., None] * values).flatten(1).numpy()).reshape(values.shape)
    torch.testing.assert_close(smooth_columns(values, weights, hertz, fps), torch.from_numpy(wanted))


PROPOSALS = {
    "right": lambda quats, fps: quats,
    "turned by 3 degrees": lambda quats, fps: turn(quats, 3.0),
    "turned by 60 degrees": lambda quats, fps: turn(quats, 60.0),
    "drifting": lambda quats, fps: turn(quats, torch.linspace(-20, 20, len(quats))),
    "frantic": lambda quats, fps: turn(quats, 40 * torch.sin(40 * torch.arange(len(quats)) / fps)),
    "noise of its own": lambda quats, fps: shake(quats, 3 * SIGMA, seed=1),
}


@pytest.mark.parametrize("fps", RATES)
@pytest.mark.parametrize("kind", PROPOSALS)
def test_a_good_proposal_is_taken_and_a_bad_one_does_no_harm(kind, fps):
    wanted = truth(fps)
    capture, proposal = shake(wanted), PROPOSALS[kind](wanted, fps)
    fused = fuse_rotations(proposal, capture, everywhere(wanted), LEVEL, fps)
    alone = fuse_rotations(None, capture, everywhere(wanted), LEVEL, fps)
    assert error(alone.values, wanted) < 0.5 * error(capture, wanted)
    best = min(error(proposal, wanted), error(alone.values, wanted))
    assert error(fused.values, wanted) < 1.15 * best + 0.4
    assert (float(fused.share.mean()) > 0.8) == (kind == "right")
    assert math.degrees(float(fused.error.mean())) == pytest.approx(error(fused.values, wanted) / math.sqrt(3), abs=1.0)


@pytest.mark.parametrize("fps", RATES)
def test_a_kick_that_the_proposal_misses_survives(fps):
    """A tenth of a second in which a joint turns by 50 degrees and back."""
    time = torch.arange(round(8 * fps), dtype=torch.float64) / fps
    wanted = turn(truth(fps), 50 * torch.exp(-(((time - 4) / 0.05) ** 2)))
    fused = fuse_rotations(truth(fps), shake(wanted, 1 * DEGREE), everywhere(wanted), 0.2 * LEVEL, fps)
    during = (time - 4).abs() < 0.1
    assert float(apart_deg(fused.values, wanted)[during].mean()) < 4.0
    assert float(apart_deg(fused.values, wanted)[~during & ((time - 4).abs() > 1.5)].mean()) < 1.0


def test_noise_slower_than_the_frames_is_smoothed_where_its_rate_is_given():
    """Tremor as of video: noise drawn 15 times a second, in a capture of 60 frames a second."""
    wanted, fps = truth(60.0), 60.0
    slow = torch.randn(len(wanted) // 4 + 2, wanted.shape[1], 3, generator=generator(), dtype=torch.float64)
    tremor = torch.nn.functional.interpolate(slow.flatten(1).T[None], size=len(wanted), mode="linear")[0].T
    turned = rotations.from_rotation_vector(2 * DEGREE * tremor.unflatten(-1, (-1, 3)))
    capture, level = rotations.multiply(wanted, turned), torch.full_like(LEVEL, 2 * DEGREE)
    white, given = (
        fuse_rotations(None, capture, everywhere(wanted), level, fps, rate).values for rate in (math.inf, 15.0)
    )
    assert error(given, wanted) < 0.75 * error(white, wanted)
    assert error(given, wanted) < 0.6 * error(capture, wanted)


def test_without_noise_the_capture_is_the_truth_and_gaps_are_the_proposals():
    wanted = truth(30.0)
    seen = everywhere(wanted)
    seen[100:105] = False
    proposal = turn(wanted, 2.0)
    fused = fuse_rotations(proposal, wanted, seen, 0 * LEVEL, 30.0)
    assert float(apart_deg(fused.values, wanted)[seen].max()) < 1e-6
    assert float(apart_deg(fused.values, wanted).max()) < 0.2  # as far beside the truth as the residual on both sides


def test_positions_are_fused_in_the_same_manner():
    time = torch.arange(240, dtype=torch.float64) / 30
    wanted = torch.stack([time, 0.9 + 0.05 * torch.sin(8 * time), 0 * time], dim=-1)
    capture = wanted + 0.02 * torch.randn(240, 3, generator=generator()).double()
    seen = torch.ones(240, dtype=torch.bool)
    fused = fuse_positions(wanted, capture, seen, 0.02, 30.0).values[:, 0]
    assert float((fused - wanted).norm(dim=-1).mean()) < 0.003
    assert torch.equal(fuse_positions(wanted + 1.0, capture, seen, 0.0, 30.0).values[:, 0], capture)
