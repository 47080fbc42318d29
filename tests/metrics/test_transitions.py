"""LaFAN1's measures against the definitions written out anew in numpy, with flipped signs and a joint that stands."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mapctl.metrics import transitions

WINDOWS, FRAMES, JOINTS = 6, 12, 4


def make_rotations(seed, wobble=0.3):
    """Smooth random world rotations, xyzw, signs continuous; joint 0 stands."""
    random = np.random.default_rng(seed)
    steps = wobble * random.standard_normal((WINDOWS, 3, JOINTS, 3))
    weight = np.linspace(0, 1, FRAMES)[:, None, None]
    vectors = 2.5 * steps[:, :1] * weight + steps[:, 1:2] * np.sin(6 * weight) + steps[:, 2:3]
    vectors[:, :, 0] = [0.2, -0.1, 0.4]
    return torch.tensor(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat().reshape(WINDOWS, FRAMES, JOINTS, 4))


@pytest.fixture
def pair():
    return make_rotations(1), make_rotations(2)


def flip_signs(quats, seed=3):
    random = np.random.default_rng(seed)
    return quats * torch.tensor(random.choice([-1.0, 1.0], size=(*quats.shape[:-1], 1)))


def l2q_by_definition(made, truth):
    """LaFAN1's, each predicted quaternion the nearer of its two signs."""
    total = 0.0
    for window in range(WINDOWS):
        for frame in range(FRAMES):
            square = 0.0
            for joint in range(JOINTS):
                a, b = made[window, frame, joint].numpy(), truth[window, frame, joint].numpy()
                square += min(np.sum((a - b) ** 2), np.sum((a + b) ** 2))
            total += np.sqrt(square)
    return total / (WINDOWS * FRAMES)


def npss_by_definition(made, truth):
    """LaFAN1's utils: only the real part, normalised by coordinate, pooled with the truth's power as weight."""
    made, truth = (x.numpy().reshape(WINDOWS, FRAMES, -1) for x in (made, truth))
    total = weight = 0.0
    for window in range(WINDOWS):
        for column in range(truth.shape[2]):
            a, b = (np.real(np.fft.fft(x[window, :, column])) ** 2 for x in (truth, made))
            if a.sum() > 1e-9:
                total += a.sum() * np.abs(np.cumsum(a / a.sum()) - np.cumsum(b / b.sum())).sum()
                weight += a.sum()
    return total / weight


def test_l2p_is_the_length_of_all_standardised_coordinates():
    random = np.random.default_rng(0)
    made, truth = (torch.tensor(random.standard_normal((WINDOWS, FRAMES, JOINTS, 3))) for _ in range(2))
    std = torch.tensor(random.uniform(0.1, 2, (JOINTS, 3)))
    flat = ((made - truth) / std).reshape(WINDOWS * FRAMES, -1).numpy()
    assert transitions.compute_l2p(made, truth, std) == pytest.approx(np.sqrt((flat**2).sum(axis=1)).mean(), rel=1e-12)


def test_l2q_against_the_definition_and_whatever_the_signs(pair):
    made, truth = pair
    wanted = l2q_by_definition(made, truth)
    assert transitions.compute_l2q(made, truth) == pytest.approx(wanted, rel=1e-9)
    assert transitions.compute_l2q(flip_signs(made), truth) == pytest.approx(wanted, rel=1e-9)
    assert transitions.compute_l2q(flip_signs(truth), truth) == pytest.approx(0, abs=1e-9)


def test_npss_against_the_definition_and_whatever_the_signs(pair):
    made, truth = pair
    aligned = transitions.align_signs(made, truth)
    wanted = npss_by_definition(aligned, truth)
    assert wanted > 0.01
    assert transitions.compute_npss(made, truth) == pytest.approx(wanted, rel=1e-9)
    assert transitions.compute_npss(flip_signs(made), flip_signs(truth, 4)) == pytest.approx(wanted, rel=1e-9)
    assert transitions.compute_npss(truth, truth) == 0


def test_a_coordinate_without_power_counts_nothing(pair):
    made, truth = pair
    still = torch.zeros_like(truth)
    still[..., 3] = 1
    moving = truth.clone()
    moving[:, :, 0] = still[:, :, 0]
    made = made.clone()
    made[:, :, 0] = still[:, :, 0]
    found = transitions.compute_npss(made, moving)
    assert np.isfinite(found)
    assert found == pytest.approx(npss_by_definition(transitions.align_signs(made, moving), moving), rel=1e-9)


def test_displacement_errors_of_a_shift():
    truth = torch.zeros(2, 5, 3, 3)
    made = truth.clone()
    made[:, -1, :, 0] = 0.1
    mean, last = transitions.compute_joint_distances(made, truth)
    assert (mean, last) == pytest.approx((0.02, 0.1))


def test_pairwise_distances_against_their_definition():
    draws = torch.randn(4, 6, 3, 3, generator=torch.Generator().manual_seed(2))
    pairs = [(a, b) for a in range(4) for b in range(a)]
    each = draws.numpy()
    mean = np.mean([np.linalg.norm(each[a] - each[b], axis=-1).mean() for a, b in pairs])
    flat = np.mean([np.sqrt(((each[a] - each[b]) ** 2).sum()) for a, b in pairs])
    assert transitions.compute_pairwise_distances(draws) == pytest.approx((mean, flat), rel=1e-5)
