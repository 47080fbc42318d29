"""Cameras: poses are rigid, what must be seen is in the picture, and no closer camera would do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapctl.errors import RequestError
from scenes.cameras import CameraSettings, View, camera_axes, compute_views, fit_eye, look_at

KINDS = ("fixed", "follow", "top")


def cloud(seed: int, count: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * np.array([3.0, 0.8, 2.0])


@given(st.integers(0, 1000))
def test_look_at_is_rigid_and_puts_the_target_in_the_middle(seed):
    eye, target = cloud(seed, 2)
    pose = look_at(eye, target)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    right, down, depth = View(pose, 0.8, 200, 100).project(target)
    assert (right, down) == pytest.approx((100, 50), abs=1e-6)
    assert depth == pytest.approx(np.linalg.norm(eye - target))


@given(st.integers(0, 1000), st.sampled_from(["fixed", "top"]), st.floats(-180, 180), st.floats(0.4, 3.0))
def test_fit_sees_everything_and_touches_two_opposite_edges(seed, kind, azimuth, aspect):
    points, fov = cloud(seed), 0.6
    axes = camera_axes(CameraSettings(kind=kind, azimuth_deg=azimuth))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, fit_eye(points, axes, fov=fov, aspect=aspect)
    height = 1000
    seen = View(pose, fov, round(height * aspect), height).project(points)
    share = (seen[:, :2] / np.array([round(height * aspect), height])).T
    assert seen[:, 2].min() > 0
    assert share.min() > -2e-3
    assert share.max() < 1 + 2e-3
    assert any(axis.min() < 2e-3 and axis.max() > 1 - 2e-3 for axis in share)
    assert share.min(axis=1) + share.max(axis=1) == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_everybody_is_in_every_picture(kind):
    frames = 30
    path = np.stack([np.linspace(0, 9, frames), np.full(frames, 0.9), np.sin(np.linspace(0, 6, frames))], axis=1)
    points = path[:, None] + cloud(1, 8) * 0.2
    for k, view in enumerate(compute_views(CameraSettings(kind=kind), points, path, fps=30.0, size=(160, 90))):
        seen = view.project(points[k])
        assert ((seen[:, :2] > 0) & (seen[:, :2] < [160, 90])).all()


def test_a_following_camera_moves_and_a_fixed_one_does_not():
    path = np.linspace([0, 1, 0], [10, 1, 0], 50)
    eyes = {
        kind: np.array(
            [
                v.pose[:3, 3]
                for v in compute_views(CameraSettings(kind=kind), path[:, None], path, fps=30.0, size=(64, 64))
            ]
        )
        for kind in KINDS
    }
    assert np.ptp(eyes["fixed"], axis=0).max() == np.ptp(eyes["top"], axis=0).max() == 0
    assert 8 < np.ptp(eyes["follow"][:, 0]) <= 10
    assert np.ptp(eyes["follow"][:, 1:], axis=0).max() < 1e-9


@pytest.mark.parametrize(
    ("change", "words"),
    [({"elevation_deg": 95.0}, "0 to 89"), ({"zoom": 0.0}, "zoom"), ({"fov_deg": float("nan")}, "fov_deg")],
)
def test_impossible_cameras_are_refused(change, words):
    with pytest.raises(RequestError, match=words):
        CameraSettings(**change)
