"""The mannequin: one skin with the right volume, on any rig, that moves, turns and grows with the skeleton."""

import numpy as np
import pytest
import scipy
from helpers import moved, random_motion
from scenes_walks import renamed, scaled, walk

from mapctl.mesh import colours
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.isosurface import Solid, mesh_union
from mapctl.mesh.mannequin import Body, at_rest, build_skin
from mapctl.mesh.primitives import Surface
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


def joined(mesh: CharacterMesh) -> np.ndarray:
    """Triangles over vertices that lie apart: an edge between colours has two vertices at one position."""
    _, number = np.unique(mesh.vertices.round(7), axis=0, return_inverse=True)
    return number.reshape(-1)[mesh.faces]


def test_a_capsules_skin_lies_a_radius_from_its_axis_and_its_normals_point_away_from_it():
    rows = np.array([[0, 0.1, 0.1, 0, 0], [1, 0.1, 0.1, 0, 0]])
    start, end = np.array([0.3, 0.6, -2.0]), np.array([0.3, 1.4, -2.0])
    lines = [np.arange(low, high, 0.02) for low, high in ((0.1, 0.5), (0.4, 1.6), (-2.2, -1.8))]
    solid = Solid(start, end, np.array([1.0, 0, 0]), rows)
    vertices, normals, faces = mesh_union([solid], lines, 1.0)
    away = vertices - np.array([0.3, 0, -2.0]) - np.clip(vertices[:, [1]], 0.6, 1.4) * [[0, 1, 0]]
    assert np.linalg.norm(away, axis=1) == pytest.approx(0.1, abs=1e-3)
    assert normals == pytest.approx(away / 0.1, abs=0.05)
    exact = np.pi * 0.1**2 * (0.8 + 4 / 3 * 0.1)
    assert volume(Surface(vertices, faces, normals)) == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize(
    "motion", [at_rest(), walk(), random_motion(CANONICAL, 9, seed=2)], ids=["rest", "walk", "random"]
)
def test_a_body_is_one_closed_skin_of_a_persons_volume(motion):
    mesh = build_skin(motion)
    faces = joined(mesh)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    sides = np.unique(edges, axis=0, return_counts=True)[1]
    assert (sides % 2 == 0).all()
    assert (sides > 2).mean() < 0.002, "where two parts of the skin touch"
    links = scipy.sparse.coo_array((np.ones(len(edges)), edges.T), shape=(faces.max() + 1,) * 2)
    assert scipy.sparse.csgraph.connected_components(links)[0] == 1
    assert 0.03 < volume(Surface(mesh.vertices, mesh.faces, mesh.rgba)) < 0.09
    assert mesh.joints.shape[1] == 4
    assert mesh.weights.sum(axis=1) == pytest.approx(1.0)


def test_limbs_have_no_web_between_them():
    mesh = build_skin(at_rest())
    carrier = mesh.joints[np.arange(len(mesh.joints)), mesh.weights.argmax(axis=1)][mesh.faces]
    apart = (("leftLowerLeg", "rightLowerLeg"), ("leftHand", "leftUpperLeg"), ("leftLowerArm", "spine"))
    for pair in apart:
        one, other = ((carrier == CANONICAL.index(name)).any(axis=1) for name in pair)
        assert one.sum() > 100
        assert not (one & other).any()


def test_the_nose_points_ahead():
    motion = walk()
    for turn in (0.0, 2.0):
        body = Body.of(moved(motion, turn=turn, shift=(0.0, 0.0)), GREY)
        ahead = np.array([np.sin(turn), 0.0, np.cos(turn)])
        skin = body.surface(0).vertices
        face = skin[skin[:, 1] > skin[:, 1].max() - 0.2]
        nose = face[np.argmax(face @ ahead)] - face.mean(axis=0)
        assert nose @ ahead > 0.08
        assert abs(nose @ np.cross(ahead, [0, 1, 0])) < 0.015


def test_a_body_moves_and_turns_with_its_motion():
    motion, frame = walk(), 5
    there = moved(motion, turn=0.7, shift=(2.0, -1.0))
    skin, skin_there = (Body.of(m, GREY).surface(frame).vertices for m in (motion, there))
    cosine, sine = np.cos(0.7), np.sin(0.7)
    turned = skin @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    assert skin_there == pytest.approx(turned + np.array([2.0, 0, -1.0]), abs=1e-5)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_body_is_as_large_as_its_bones(factor):
    motion = walk()
    skin, larger = (Body.of(m, GREY).surface(3).vertices for m in (motion, scaled(motion, factor)))
    assert larger == pytest.approx(skin * factor, abs=1e-5)


def test_left_sleeve_is_blue_and_right_is_orange_and_the_shirt_is_the_actors():
    motion = walk()
    skin, joints = Body.of(motion, colours.rgb("green")).surface(0), motion.joint_positions()[0].numpy()

    def colour_at(*names: str) -> np.ndarray:
        middle = joints[[CANONICAL.index(name) for name in names]].mean(axis=0)
        return skin.rgba[np.linalg.norm(skin.vertices - middle, axis=1).argmin(), :3]

    for side, colour in (("left", colours.LEFT), ("right", colours.RIGHT)):
        assert colour_at(f"{side}LowerArm", f"{side}Hand") == pytest.approx(colours.rgb(colour))
        assert colour_at(f"{side}Foot") == pytest.approx(colours.rgb(colour))
    assert colour_at("chest", "spine") == pytest.approx(colours.rgb("green"))


def test_soles_stand_on_the_ground_in_the_upright_pose():
    assert Body.of(walk(), GREY).surface(0).vertices[:, 1].min() == pytest.approx(0.0, abs=0.01)


def test_another_rigs_names_give_the_same_body():
    motion = walk()
    # The canonical order: limbs of one side after each other, legs after arms.
    same = renamed(motion, MIXAMO)
    assert Body.of(same, GREY).surface(2).vertices == pytest.approx(Body.of(motion, GREY).surface(2).vertices)


def test_unknown_names_get_thin_capsules():
    strange = renamed(walk(), tuple(f"j{k}x" for k in range(CANONICAL.num_joints)))
    skin, joints = Body.of(strange, GREY).surface(0), strange.joint_positions()[0].numpy()
    assert len(skin.vertices) > 500
    starts, ends = joints[list(CANONICAL.parents[1:])], joints[1:]
    share = np.linspace(0, 1, 30)[:, None, None]
    near = scipy.spatial.cKDTree((starts + share * (ends - starts)).reshape(-1, 3)).query(skin.vertices)[0]
    assert np.median(near) < 0.03
