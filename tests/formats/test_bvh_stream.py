"""A BVH file written piece by piece is the one that is written at once."""

from dataclasses import replace
from fractions import Fraction

import pytest
import torch

import mapctl
from mapctl import rotations
from mapctl.errors import MapctlError, RequestError
from mapctl.formats.bvh.stream import open_bvh_stream
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

FRAMES = 60


def spinning(rate: float, frames: int = FRAMES) -> Motion:
    """Every joint turns steadily about an axis of its own, `rate` radians a frame: through every wrap."""
    generator = torch.Generator().manual_seed(2)
    axes = torch.nn.functional.normalize(torch.randn(CANONICAL.num_joints, 3, generator=generator).double(), dim=-1)
    vectors = axes * (rate * torch.arange(frames)[:, None, None])
    quat_xyzw = rotations.make_sign_continuous(rotations.from_rotation_vector(vectors))
    root = torch.randn(frames, 3, generator=generator).double().cumsum(0)
    return Motion(CANONICAL, Fraction(30), root, quat_xyzw)


def stream(motion: Motion, path, cuts: list[int]) -> None:
    with open_bvh_stream(path, motion.num_frames) as file:
        for start, stop in zip([0, *cuts], [*cuts, motion.num_frames], strict=True):
            file.append(motion.slice(start, stop))


@pytest.mark.parametrize("cuts", [[], [1], [59], [20, 40], [7, 8, 33]])
def test_same_bytes_as_at_once(tmp_path, cuts):
    """Slow turns, whose angles no piece can wind up otherwise than the whole."""
    motion = spinning(0.01)
    motion.save(tmp_path / "whole.bvh")
    stream(motion, tmp_path / "pieces.bvh", cuts)
    assert (tmp_path / "pieces.bvh").read_bytes() == (tmp_path / "whole.bvh").read_bytes()


@pytest.mark.parametrize("rate", [0.05, 0.15])
def test_angles_go_on_over_the_cuts(tmp_path, rate):
    """No channel jumps at a cut by more than it does anywhere in the whole, and the rotations are the same."""
    motion = spinning(rate)
    motion.save(tmp_path / "whole.bvh")
    stream(motion, tmp_path / "pieces.bvh", [15, 31, 47])
    whole, pieces = (mapctl.load(tmp_path / name) for name in ("whole.bvh", "pieces.bvh"))
    assert float((whole.joint_positions() - pieces.joint_positions()).abs().max()) < 1e-4

    def steps(name: str) -> torch.Tensor:
        rows = (tmp_path / name).read_text().splitlines()[-FRAMES:]
        return torch.tensor([[float(word) for word in row.split()] for row in rows]).diff(dim=0).abs()

    assert float(steps("pieces.bvh").max()) <= float(steps("whole.bvh").max()) + 1e-3


@pytest.mark.parametrize("frames", [FRAMES - 1, FRAMES + 1])
def test_a_wrong_count_leaves_no_file(tmp_path, frames):
    with pytest.raises(MapctlError, match="announced"), open_bvh_stream(tmp_path / "a.bvh", frames) as file:
        file.append(spinning(0.01))
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_finite_leaves_the_old_file_alone(tmp_path):
    motion = spinning(0.01)
    broken = replace(motion, root_position=motion.root_position * float("nan"))
    with open_bvh_stream(tmp_path / "a.bvh", FRAMES) as file:
        file.append(motion)
    before = (tmp_path / "a.bvh").read_bytes()
    with pytest.raises(RequestError, match="finite"), open_bvh_stream(tmp_path / "a.bvh", FRAMES) as file:
        file.append(broken)
    assert (tmp_path / "a.bvh").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.bvh"]


def test_places_that_cannot_be_written(tmp_path):
    with pytest.raises(RequestError, match="does not exist"), open_bvh_stream(tmp_path / "gone" / "a.bvh", 1):
        pass
