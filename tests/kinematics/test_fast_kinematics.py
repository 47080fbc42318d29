"""The compiled kinematics and curve search against the torch code that specifies them."""

import pytest
import torch
from catalogue import FRAMES, TERMS
from helpers import generator, walk

from mapctl.features import LAYOUT, GroundPose, encode, integrate_root
from mapctl.kinematics import fast
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.trial import Trial

PAST = 8
each_term = pytest.mark.parametrize("name", TERMS)


@pytest.fixture
def reference(monkeypatch):
    """A switch that leaves only the torch code."""

    def switch():
        monkeypatch.setattr(fast, "is_supported", lambda features, start, skeleton: False)

    return switch


def trial(batch=3, *, features=None, position=None, skeleton=CANONICAL, dtype=torch.float32):
    """Disturbed windows of a walk, with the walk before them; features are a leaf that gradients reach."""
    motion = walk(PAST + FRAMES, turn_rate=0.2)
    vectors, start = encode(motion)
    ground, heading = integrate_root(vectors[:PAST], start)
    if features is None:
        noise = torch.randn(batch, FRAMES, LAYOUT.size, generator=generator(0)).double()
        features = vectors[PAST:] + 0.05 * vectors.std(0) * noise
    position = position or GroundPose(ground[-1], heading[-1])
    draw = torch.randn(batch, FRAMES, LAYOUT.continuous + 1, generator=generator(1))
    bits = torch.rand(batch, FRAMES, 2, generator=generator(2)) < 0.6
    return Trial(
        features.to(dtype).requires_grad_(),
        GroundPose(position.position_xz.to(dtype), position.heading.to(dtype)),
        contacts=bits,
        noise=draw[..., 1:].to(dtype),
        log_density=draw[..., 0].to(dtype),
        before=motion.joint_positions()[:PAST].to(dtype),
        skeleton=skeleton,
    )


def close(found, expected, tolerance=1e-4):
    """Within a share of the largest expected number."""
    scale = float(expected.abs().max())
    torch.testing.assert_close(found.double(), expected.double(), rtol=0, atol=tolerance * scale + 1e-12)


def root_of(whole):
    return torch.cat([whole.root_xz_world, whole.heading.unsqueeze(-1)], dim=-1)


def body_of(whole):
    return whole.joints_world


def everything_of(whole):
    return torch.cat([root_of(whole), whole.joints_world.flatten(2), whole.heels_world.flatten(2)], dim=-1)


PARTS = (root_of, body_of, everything_of)


def value_and_gradient(whole, part):
    value = part(whole)
    weights = torch.randn(value.shape, generator=generator(3)).to(value.dtype)
    if not value.requires_grad:  # a term of the prior's alone
        return value, torch.zeros_like(whole.features)
    return value.detach(), torch.autograd.grad((value * weights).sum(), whole.features)[0]


def agree(part, **options):
    """The compiled float32 answers lie close to the torch code's in float64."""
    quick, exact = trial(**options), trial(**options, dtype=torch.float64)
    assert quick._use_kernels
    assert not exact._use_kernels
    for found, expected in zip(value_and_gradient(quick, part), value_and_gradient(exact, part), strict=True):
        assert found.dtype == torch.float32
        close(found, expected, 1e-5)


@each_term
def test_every_term_agrees_in_value_and_gradient(name, reference):
    quick = value_and_gradient(trial(), TERMS[name])
    reference()
    slow = value_and_gradient(trial(), TERMS[name])
    for found, expected in zip(quick, slow, strict=True):
        close(found, expected)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("batch", [1, 3])
def test_kinematics_agree_with_double_precision(part, batch):
    agree(part, batch=batch)


@pytest.mark.parametrize("size", [0.0, 1e-4, 0.0999, 0.1001, 7.0])
def test_rotation_vectors_of_any_size_have_exact_gradients(size):
    features = torch.randn(2, FRAMES, LAYOUT.size, generator=generator(4)).double()
    turns = features[..., LAYOUT.slices["root_tilt"].start : LAYOUT.slices["joint_rotations"].stop]
    triples = turns[..., 2:].unflatten(-1, (-1, 3))
    triples *= size / triples.norm(dim=-1, keepdim=True)
    turns[..., :2] *= size / turns[..., :2].norm(dim=-1, keepdim=True)
    agree(body_of, batch=2, features=features)


def test_bones_do_not_lie_in_the_memory_of_the_skeleton():
    """Sent to another process, a tensor moves to shared memory, and where it was is soon written over."""
    skeleton, features = Skeleton(CANONICAL.names, CANONICAL.parents, CANONICAL.offsets.clone()), encode(walk(8))[0]
    position = (features[None].float(), GroundPose(torch.zeros(1, 2), torch.zeros(1)), skeleton)
    before = fast.compute_world_poses(*position)[2]
    skeleton.offsets.fill_(torch.nan)
    torch.testing.assert_close(fast.compute_world_poses(*position)[2], before, rtol=0, atol=0)
