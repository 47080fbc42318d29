"""The network that proposes: what it does untrained, what it never does with any weights, and its file."""

import math
from dataclasses import replace

import pytest
import torch
from captures import DEGREE
from helpers import generator, walk
from tiny_denoiser import network, tiny_denoiser

from mapctl import rotations
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL
from priors import denoiser as denoiser

JOINTS = CANONICAL.num_joints


def capture(frames=90, *, degrees=0.0, centimetres=0.0, seed=0, turn_rate=0.8):
    """A walk with white noise, everything seen."""
    motion = walk(frames, turn_rate=turn_rate)
    seen = torch.ones(frames, JOINTS, dtype=torch.bool)
    clean = Capture.of_motion(
        motion,
        seen=seen,
        seen_root=seen[:, 0],
        sigma=torch.full((JOINTS,), degrees * DEGREE),
        sigma_root=centimetres / 100,
    )
    draw = generator(seed)
    quats = torch.cat([clean.hips[:, :, None], rotations.from_rotation_vector(clean.joints)], dim=2)
    noise = degrees * DEGREE * torch.randn(1, frames, JOINTS, 3, generator=draw)
    quats = rotations.multiply(quats, rotations.from_rotation_vector(noise))
    root = clean.root + centimetres / 100 * torch.randn(1, frames, 3, generator=draw)
    return replace(clean, root=root, hips=quats[:, :, 0], joints=rotations.to_rotation_vector(quats[:, :, 1:]))


def errors(cleaned, truth):
    """Root mean square: of the place in cm, of the angles in degrees."""
    angles = torch.cat([truth.tilt, truth.joints.flatten(2)], dim=-1)
    return (
        100 * float((cleaned.pose.root_position - truth.root).square().mean().sqrt()),
        float(torch.rad2deg((cleaned.pose.angles - angles).square().mean().sqrt())),
    )


def test_untrained_it_smooths():
    noisy, truth = capture(degrees=5, centimetres=3), capture()
    cleaned = network()(noisy)
    position, angle = errors(cleaned, truth)
    assert position < 0.6 * 3
    assert angle < 0.6 * 5
    assert float(torch.rad2deg((cleaned.pose.heading - truth.heading).square().mean().sqrt())) < 0.6 * 5


@pytest.mark.parametrize("drawn", [0.0, 0.3])
def test_without_noise_what_was_seen_is_what_comes_back(drawn):
    """Whatever the weights are."""
    seen = capture()
    cleaned = network(drawn=drawn)(seen)
    position, angle = errors(cleaned, seen)
    assert position < 1e-3
    assert angle < 1e-3
    assert torch.allclose(cleaned.pose.heading, seen.heading, atol=1e-5)


def test_little_noise_changes_little():
    clean = capture()
    changes = []
    for degrees in (0.01, 0.1, 1.0):
        given = replace(clean, sigma=clean.sigma + degrees * DEGREE)
        changes.append(errors(network(drawn=0.3)(given), clean)[1])
    assert changes[0] < 0.1 * changes[1] < 0.1 * changes[2]


def moved(given, angle, offset):
    """The same capture elsewhere on the ground, facing elsewhere."""
    turn = torch.tensor(angle).expand(given.root.shape[:2])
    ground = rotations.rotate_ground(given.root[..., ::2], turn)
    root = torch.stack([ground[..., 0], given.root[..., 1], ground[..., 1]], dim=-1) + torch.tensor(offset)
    return replace(given, root=root, hips=rotations.multiply(rotations.about_y(turn), given.hips))


@pytest.mark.parametrize("drawn", [0.0, 0.3])
def test_it_does_not_matter_where_the_capture_stands_and_faces(drawn):
    noisy = capture(degrees=5, centimetres=3)
    noisy = replace(noisy, seen=torch.rand(noisy.seen.shape, generator=generator(1)) > 0.1)
    here, there = network(drawn=drawn)(noisy), network(drawn=drawn)(moved(noisy, 2.2, (5.0, 0.0, -3.0)))
    turn = torch.full_like(here.pose.heading, 2.2)
    ground = rotations.rotate_ground(here.pose.root_position[..., ::2], turn) + torch.tensor([5.0, -3.0])
    assert torch.allclose(there.pose.root_position[..., ::2], ground, atol=1e-4)
    assert torch.allclose(there.pose.root_position[..., 1], here.pose.root_position[..., 1], atol=1e-5)
    off = rotations.wrap_angle(there.pose.heading - here.pose.heading - 2.2)
    assert off.abs().max() < 1e-4
    assert torch.allclose(there.pose.angles, here.pose.angles, atol=1e-4)
    assert torch.allclose(there.contact_logits, here.contact_logits, atol=1e-3)


def test_what_was_not_seen_does_not_matter():
    noisy = capture(degrees=5, centimetres=3)
    noisy.seen[:, 30:40, 4] = False
    noisy.seen[:, 50:55] = False
    noisy.seen_root[:, 50:55] = False
    wild = replace(
        noisy,
        root=torch.where(noisy.seen_root[..., None], noisy.root, 7.0),
        joints=torch.where(noisy.seen[..., 1:, None], noisy.joints, 2.0),
    )
    first, second = network(drawn=0.3)(noisy), network(drawn=0.3)(wild)
    assert torch.equal(first.pose.pack(), second.pose.pack())
    assert torch.equal(first.contact_logits, second.contact_logits)


@pytest.mark.parametrize("frames", [1, 2, 9])
def test_short_captures_break_nothing(frames):
    cleaned = tiny_denoiser(drawn=0.3).clean(capture(frames, degrees=5))
    assert cleaned.pose.root_position.shape == (1, frames, 3)
    assert cleaned.pose.local_quat_xyzw.shape == (1, frames, JOINTS, 4)


def test_a_long_capture_in_pieces_is_one_pass(monkeypatch):
    """Beside the margin; whole turns of the heading are counted on."""
    noisy = capture(400, degrees=5, centimetres=3, turn_rate=2.0)
    whole = tiny_denoiser(drawn=0.1).clean(noisy)
    monkeypatch.setattr(denoiser, "_CHUNK_FRAMES", 100)
    pieces = tiny_denoiser(drawn=0.1).clean(noisy)
    assert whole.pose.root_position.shape == pieces.pose.root_position.shape
    assert torch.allclose(pieces.pose.root_position, whole.pose.root_position, atol=1e-3)
    assert torch.allclose(pieces.pose.angles, whole.pose.angles, atol=1e-3)
    assert torch.allclose(pieces.contact_logits, whole.contact_logits, atol=1e-2)
    assert torch.diff(pieces.pose.heading, dim=1).abs().max() < 1.0
    apart = (pieces.pose.heading - whole.pose.heading)[0]
    assert (apart - apart.mean()).abs().max() < 1e-2
    assert pieces.pose.heading[0, -1] - pieces.pose.heading[0, 0] > 2 * 2 * math.pi
