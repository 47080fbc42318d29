"""Features: invertible, free of place and heading, and mirrored as the motion is."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import finite_difference, generator, moved, random_motion, walk

from mapctl import features, rotations
from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, GroundPose, encode, integrate_root, mirror_features
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.skeleton import CANONICAL

MOTIONS = {"walk": walk(40, turn_rate=1.0), "anything": random_motion(CANONICAL, 30)}
each_motion = pytest.mark.parametrize("kind", MOTIONS)


@each_motion
def test_decoding_gives_the_motion_back(kind):
    motion = MOTIONS[kind]
    back = decode(*encode(motion))
    torch.testing.assert_close(back.root_position, motion.root_position, atol=1e-9, rtol=0)
    torch.testing.assert_close(back.joint_positions(), motion.joint_positions(), atol=1e-8, rtol=0)
    dots = (back.local_quat_xyzw * motion.local_quat_xyzw).sum(-1).abs()
    torch.testing.assert_close(dots, torch.ones_like(dots), atol=1e-9, rtol=0)


@each_motion
@pytest.mark.parametrize("turn", [3.0])
def test_features_know_neither_place_nor_heading(kind, turn):
    motion = MOTIONS[kind]
    here, start = encode(motion)
    there, place = encode(moved(motion, turn=turn, shift=(5.0, -3.0)))
    torch.testing.assert_close(there, here, atol=1e-9, rtol=0)
    assert float(rotations.wrap_angle(place.heading - start.heading - turn).abs()) < 1e-9


@each_motion
def test_mirrored_features_are_those_of_the_mirrored_motion(kind):
    motion = MOTIONS[kind]
    torch.testing.assert_close(mirror_features(encode(motion)[0]), encode(motion.mirror())[0], atol=1e-9, rtol=0)
    torch.testing.assert_close(mirror_features(mirror_features(encode(motion)[0])), encode(motion)[0])


def test_a_straight_walk_reads_in_metres_and_radians_a_frame():
    straight, _ = encode(walk(30))
    torch.testing.assert_close(
        LAYOUT.pick(straight, "root_displacement_heading")[:, 0].mean(), torch.tensor(0.0).double(), atol=1e-3, rtol=0
    )
    assert float(LAYOUT.pick(straight, "root_displacement_heading")[:, 1].mean()) * 30 == pytest.approx(1.24, abs=0.01)
    turning, _ = encode(walk(90, turn_rate=0.6))
    assert float(LAYOUT.pick(turning, "heading_change").mean()) * 30 == pytest.approx(0.6, abs=0.02)
    bits = LAYOUT.pick(turning, "contacts")
    assert bool(((bits == 0) | (bits == 1)).all())
    assert 0.1 < float(bits.mean()) < 0.9


def test_the_root_integration_is_eq_4_step_by_step():
    vectors, place = encode(walk(20, turn_rate=2.0))
    ground, heading = integrate_root(vectors, place)
    for t, frame in enumerate(vectors):
        place = place.displace(LAYOUT.pick(frame, "root_displacement_heading"), LAYOUT.pick(frame, "heading_change")[0])
        torch.testing.assert_close((ground[t], heading[t]), (place.position_xz, place.heading), atol=1e-12, rtol=0)


def test_gradients_of_the_root_integration_are_those_of_finite_differences():
    vectors = torch.randn(2, 7, LAYOUT.size, generator=generator(), dtype=torch.float64)
    place = GroundPose(
        torch.randn(2, 2, generator=generator(1), dtype=torch.float64), torch.tensor([0.3, -2.0]).double()
    )
    weight = torch.randn(2, 7, 2, generator=generator(2), dtype=torch.float64)

    def measure(values):
        ground, heading = integrate_root(values, place)
        return (ground * weight).sum() + heading.sin().sum()

    leaf = vectors.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(measure(leaf), leaf)
    direction = torch.randn(vectors.shape, generator=generator(3), dtype=torch.float64)
    assert math.isclose(
        float((gradient * direction).sum()), finite_difference(measure, vectors, direction), rel_tol=1e-6
    )


def test_the_layout_tiles_the_vector_and_its_fingerprint_tells_it_from_others():
    covered = [i for part in LAYOUT.slices.values() for i in range(part.start, part.stop)]
    assert covered == list(range(LAYOUT.size))
    assert LAYOUT.slices["contacts"] == slice(LAYOUT.continuous, LAYOUT.size)
    other = features.FeatureLayout((*LAYOUT.blocks[:-1], ("contacts", 4)))
    assert other.fingerprint() != LAYOUT.fingerprint()


def test_motions_that_have_no_features_are_refused():
    with pytest.raises(MapctlError, match="at least two frames"):
        encode(walk(1))
    renamed = replace(CANONICAL, names=("pelvis", *CANONICAL.names[1:]))
    with pytest.raises(MapctlError, match="canonical motion"):
        encode(Motion(renamed, *(getattr(walk(3), f) for f in ("fps", "root_position", "local_quat_xyzw"))))
