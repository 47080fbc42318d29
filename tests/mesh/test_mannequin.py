"""The mannequin: solids with the right volume, on any rig, that move, turn and grow with the skeleton."""

import numpy as np
import pytest
from helpers import moved
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes_walks import renamed, scaled, walk

from mapctl.mesh import colours
from mapctl.mesh.mannequin import Mannequin
from mapctl.mesh.primitives import RoundedBoxes, Surface, frame_along
from mapctl.skeleton import CANONICAL

GREY = colours.rgb("slate")
LIMBS = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
MIXAMO = (
    *("Hips", "Spine", "Spine1", "Neck", "Head"),
    *(f"mixamorig:{side}{bone}" for side in ("Left", "Right") for bone in LIMBS),
)


def volume(surface: Surface) -> float:
    """By the divergence theorem; positive if triangles wind counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def one(half, radius, squash=(1, 1, 1), axis=(0, 1, 0)) -> Surface:
    frame = frame_along(np.array([axis], float), np.array([[1.0, 0, 0]]))
    arrays = (np.array([v], float) for v in ((0.3, 1, -2), half, radius, squash, (1, 0, 0)))
    centre, *rest = arrays
    return RoundedBoxes(centre, frame, *rest).surface()


lengths = st.floats(0.05, 1.0)


@settings(max_examples=30)
@given(st.tuples(lengths, lengths, lengths), st.floats(0.02, 0.5), st.tuples(lengths, lengths, lengths))
def test_a_rounded_box_has_the_volume_of_box_plus_ball(half, radius, axis):
    a, b, c = (2 * h for h in half)
    # Steiner's formula for a box grown by a ball.
    faces, edges = 2 * (a * b + b * c + c * a), np.pi * (a + b + c)
    exact = a * b * c + faces * radius + edges * radius**2 + 4 / 3 * np.pi * radius**3
    assert volume(one(half, (radius, radius), axis=axis)) == pytest.approx(exact, rel=0.1)
    assert volume(one(half, (radius, radius), axis=axis)) < exact


def test_a_capsules_skin_lies_a_radius_from_its_axis_and_its_normals_point_away_from_it():
    surface = one((0, 0.4, 0), (0.1, 0.1))
    local = surface.vertices - np.array([0.3, 1, -2])
    away = local - np.stack([np.zeros(len(local)), np.clip(local[:, 1], -0.4, 0.4), np.zeros(len(local))], axis=1)
    assert np.linalg.norm(away, axis=1) == pytest.approx(0.1)
    assert surface.normals == pytest.approx(away / 0.1)


def test_a_body_moves_and_turns_with_its_motion():
    motion, frame = walk(), 5
    there = moved(motion, turn=0.7, shift=(2.0, -1.0))
    skin, skin_there = (Mannequin(m, GREY).surface(frame).vertices for m in (motion, there))
    cosine, sine = np.cos(0.7), np.sin(0.7)
    turned = skin @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    assert skin_there == pytest.approx(turned + np.array([2.0, 0, -1.0]), abs=1e-9)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_body_is_as_large_as_its_bones(factor):
    motion = walk()
    skin, larger = (Mannequin(m, GREY).surface(3).vertices for m in (motion, scaled(motion, factor)))
    assert larger == pytest.approx(skin * factor, abs=1e-9)


def test_left_is_blue_and_right_is_orange_and_the_torso_is_the_actors():
    skin = Mannequin(walk(), colours.rgb("green")).surface(0)
    hands = {side: skin.rgba[np.argmax(sign * skin.vertices[:, 0]), :3] for side, sign in (("left", 1), ("right", -1))}
    assert hands["left"] == pytest.approx(colours.rgb(colours.LEFT))
    assert hands["right"] == pytest.approx(colours.rgb(colours.RIGHT))
    belly = np.linalg.norm(skin.vertices - np.array([0, 1.1, 0.1]), axis=1).argmin()
    assert skin.rgba[belly, :3] == pytest.approx(colours.rgb("green"))


def test_soles_stand_on_the_ground_in_the_upright_pose():
    assert Mannequin(walk(), GREY).surface(0).vertices[:, 1].min() == pytest.approx(0.0, abs=0.01)


def test_another_rigs_names_give_the_same_body():
    motion = walk()
    # The canonical order: limbs of one side after each other, legs after arms.
    same = renamed(motion, MIXAMO)
    assert Mannequin(same, GREY).surface(2).vertices == pytest.approx(Mannequin(motion, GREY).surface(2).vertices)


def test_unknown_names_get_thin_capsules():
    strange = renamed(walk(), tuple(f"j{k}x" for k in range(CANONICAL.num_joints)))
    body = Mannequin(strange, GREY)
    assert body.bones.radius.max() < 0.03
    assert np.isfinite(body.surface(0).vertices).all()
