"""Channels of what is not changed are written as the file had them; others go on from these."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from captures import on_rig, swaying
from lossy_files import with_all_channels

import mapctl
from mapctl import rotations
from mapctl.formats import bvh as text

FRAMES = 40


def restless(file, seed):
    """The file's angles as equal ones: now and then the other Euler solution, or by whole turns, joint by joint."""
    read, draw = text.read(file), np.random.default_rng(seed)
    values = read.values.copy()
    for _, _, columns in read.hierarchy.rotation_groups():
        for joint in columns:
            first, middle, last = values[:, joint].T
            twin = np.stack([first + 180, 180 - middle, last + 180], axis=1)
            from_frame = np.sort(draw.integers(0, FRAMES, 2))
            frame = np.arange(FRAMES)
            other = (frame >= from_frame[0]) & (frame < from_frame[1])
            turns = 360 * draw.integers(-2, 3, (4, 3))[np.sort(draw.integers(0, 4, FRAMES))]
            values[:, joint] = np.where(other[:, None], twin, values[:, joint]) + turns
    file.write_text(text.compose(read.hierarchy, read.frame_time, values, decimals=6))
    return file


@pytest.fixture(params=(1, 2))
def source(request, tmp_path):
    """A file of six channels a joint in drawn Euler orders, whose angles jump between equal ones."""
    rig = ("canonical", "bandai", "daz", "daz")[request.param]
    return restless(with_all_channels(on_rig(rig, FRAMES), tmp_path / "in.bvh", seed=request.param), request.param)


def turned(motion, start, stop, *, seed=0, size=1.0):
    """Every joint turned by something smooth in these frames, that fades in and out."""
    sway = swaying(stop - start, motion.num_joints, seed=seed, highest=2.0)
    fade = torch.sin(torch.linspace(0, torch.pi, stop - start + 2, dtype=torch.float64))[1:-1]
    vectors = size * fade[:, None, None] * rotations.to_rotation_vector(sway)
    quats = motion.local_quat_xyzw.clone()
    quats[start:stop] = rotations.multiply(quats[start:stop], rotations.from_rotation_vector(vectors))
    return replace(motion, local_quat_xyzw=quats)


def test_a_motion_comes_back_in_the_same_numbers(source, tmp_path):
    mapctl.load(source).save(tmp_path / "out.bvh")
    assert (tmp_path / "out.bvh").read_text() == source.read_text()


@pytest.mark.parametrize("gap", [(0, 12), (9, 23)])
def test_frames_that_are_not_changed_have_the_numbers_of_the_file(source, tmp_path, gap):
    start, stop = gap
    motion = turned(mapctl.load(source), start, stop)
    motion.save(tmp_path / "out.bvh")
    before, after = (text.read(path).values for path in (source, tmp_path / "out.bvh"))
    known = [frame for frame in range(FRAMES) if not start <= frame < stop]
    assert np.array_equal(before[known], after[known])
    again = mapctl.load(tmp_path / "out.bvh")
    assert (again.joint_positions() - motion.joint_positions()).abs().max() < 1e-6


@pytest.mark.parametrize("gap", [(9, 23), (30, FRAMES)])
def test_angles_in_changed_frames_go_on_from_those_before_or_lead_to_those_after(source, tmp_path, gap):
    start, stop = gap
    motion = mapctl.load(source)
    turned(motion, start, stop, size=0.02).save(tmp_path / "out.bvh")
    read = text.read(tmp_path / "out.bvh")
    edges = slice(max(0, start - 1), stop if start else stop + 1)
    for _, _, columns in read.hierarchy.rotation_groups():
        steps = np.abs(np.diff(read.values[edges][:, columns], axis=0))
        assert steps.max() < 120  # by gimbal lock, some; a whole turn or the other solution is 180 or more


def test_what_was_written_into_the_tensors_is_written(source, tmp_path):
    motion = mapctl.load(source)
    motion.root_position[7:9] += 0.5
    motion.local_quat_xyzw[20, 3] = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    motion.save(tmp_path / "out.bvh")
    again = mapctl.load(tmp_path / "out.bvh")
    assert (again.joint_positions() - motion.joint_positions()).abs().max() < 1e-6
