"""Closing seams: what is known stays to the bit, leaps at the edges go, what needs nothing gets nothing."""

import pytest
import torch
from captures import apart_deg, swaying, vectors
from helpers import generator, quat_xyzw

from mapctl import rotations
from mapctl.numerics.smooth_offsets import blend_seams_in_positions, blend_seams_in_rotations

FRAMES = 120
GAPS = [(40, 70), (50, 51), (0, 20), (117, 119)]


def gap(start, stop, frames=FRAMES):
    put = torch.zeros(frames, dtype=torch.bool)
    put[start:stop] = True
    return put


def way(fps=30.0, frames=FRAMES):
    """A smooth way (frames, 3), metres."""
    return vectors(frames, 1, fps=fps)[:, 0] + torch.arange(frames).double()[:, None] / fps


def turning_bends(quats):
    turns = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[:-1]), quats[1:]))
    return torch.diff(turns, dim=0).norm(dim=-1)


@pytest.mark.parametrize(("start", "stop"), GAPS)
def test_known_frames_stay_to_the_bit(start, stop):
    put = gap(start, stop)
    wild = way() + put[:, None] * torch.randn(FRAMES, 3, generator=generator(), dtype=torch.float64)
    assert torch.equal(blend_seams_in_positions(wild, put, fps=30.0)[~put], wild[~put])
    quats, turned = swaying(FRAMES, 2), swaying(FRAMES, 2, seed=5)
    quats[start:stop, 1] = turned[start:stop, 1]
    masks = torch.stack([torch.zeros_like(put), put], dim=1)
    closed = blend_seams_in_rotations(quats, masks, fps=30.0)
    assert torch.equal(closed[~masks], quats[~masks])


@pytest.mark.parametrize(("start", "stop"), GAPS)
def test_the_truth_is_left_nearly_alone(start, stop):
    put, truth = gap(start, stop), way()
    assert (blend_seams_in_positions(truth, put, fps=30.0) - truth).norm(dim=-1).max() < 0.005
    quats = swaying(FRAMES, 3)
    closed = blend_seams_in_rotations(quats, put[:, None].expand(-1, 3), fps=30.0)
    assert apart_deg(closed, quats).max() < 0.5


@pytest.mark.parametrize("fps", [30.0, 120.0])
@pytest.mark.parametrize(("start", "stop"), GAPS[:2])
def test_a_leap_at_the_edges_is_closed(start, stop, fps):
    frames = int(FRAMES * fps / 30)
    put = gap(int(start * fps / 30), int(stop * fps / 30), frames)[:, None]
    truth = swaying(frames, 1, fps=fps)
    turn = quat_xyzw(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)).expand(frames, 1, 4)
    leapt = torch.where(put[..., None], rotations.multiply(truth, turn), truth)
    closed = blend_seams_in_rotations(leapt, put, fps=fps)
    assert turning_bends(leapt).max() > 0.3
    assert turning_bends(closed).max() < 0.2 * turning_bends(leapt).max()
    leapt = way(fps, frames) + 0.3 * put
    bends, closed_bends = (
        torch.diff(each, n=2, dim=0).norm(dim=-1).max()
        for each in (leapt, blend_seams_in_positions(leapt, put[:, 0], fps=fps))
    )
    assert bends > 0.25
    assert closed_bends < 0.2 * bends
