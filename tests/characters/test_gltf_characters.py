"""Characters of glTF and VRM: read as rigs and clips, and written back, as a viewer of their own sees them."""

import json
import shutil

import numpy as np
import pytest
import torch
from character_maker import make_character_glb
from forged_characters import edit_glb, join_glb, split_glb
from glb_viewer import GlbViewer
from helpers import random_motion, walk
from scipy.interpolate import CubicHermiteSpline

import mapctl
from mapctl import editing, formats, retarget, rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.character import CharacterSource
from mapctl.formats.gltf.animations import Track, sample_track
from mapctl.retarget import figure
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.skeleton import CANONICAL

KINDS = {
    "mixamo": {},
    "a-pose": {"pose": "A", "leaves": "joints"},
    "posed-nodes": {"pose": "T", "node_pose": "bent"},
    "bound-in-armature": {"bind": "armature", "pose": "A"},
    "matrices": {"matrices": True, "pose": "A"},
    "unreal": {"names": "unreal", "root": "root", "leaves": "none", "pose": "A"},
    "metres": {"armature_scale": 1.0, "zup_armature": False, "names": "readyplayer"},
    "two-skins": {"second_skin": True, "hat": True, "extra_nodes": True},
    "compact": {"compact": True, "morphs": 2, "size": 1.3},
    "aligned": {"bones_along_y": False, "armature_scale": 1.0, "zup_armature": False},
    "vrm": {"names": "vrm", "armature_scale": 1.0, "zup_armature": False},
    "vrm0": {"names": "vrm0", "armature_scale": 1.0, "zup_armature": False, "size": 0.8},
}
POSITIONS = dict(rtol=0, atol=2e-6)


def make(folder, kind, **more):
    ending = ".vrm" if kind.startswith("vrm") else ".glb"
    return make_character_glb(folder / f"hero{ending}", **(KINDS[kind] | more))


def walk_of(made):
    """The animation's joints and skinned vertices over its frames, by the viewer."""
    viewer = GlbViewer(made.path)
    number = viewer.animation(made.animations[0])
    return viewer, number


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def test_the_rest_pose_is_the_bound_one(kind, tmp_path):
    made = make(tmp_path, kind)
    rest = formats.load_rest(made.path)
    at = [rest.skeleton.index(name) for name in made.names if name in rest.skeleton.names]
    told = [k for k, name in enumerate(made.names) if name in rest.skeleton.names]
    assert len(told) >= 22
    np.testing.assert_allclose(rest.joint_positions()[0, at].numpy(), made.positions[told], **POSITIONS)
    assert float(rest.local_quat_xyzw[..., 3].abs().min()) == pytest.approx(1.0)


def test_joints_are_recognised(kind, tmp_path):
    made = make(tmp_path, kind)
    rest = formats.load_rest(made.path)
    canonical, rigmap = retarget.to_canonical(rest)
    wanted = {joint: name for joint, name in made.joint.items() if joint in CANONICAL.names}
    assert rigmap.joint_names == wanted
    assert rigmap.up == "y"
    assert rigmap.facing == ("-z" if kind == "vrm0" else "z")
    # standing in the T-pose: hands far to their sides, at shoulder height where the file says T
    left = canonical.skeleton.offsets[CANONICAL.index("leftLowerArm")]
    torch.testing.assert_close(left / left.norm(), torch.tensor([1.0, 0, 0]).double(), atol=1e-6, rtol=0)
    assert rigmap.rest == ("A" if KINDS[kind].get("pose") == "A" else "T")


def test_meshes_are_where_a_viewer_draws_them(kind, tmp_path):
    made = make(tmp_path, kind, animations=("walk",))
    motion, mesh = formats.load(made.path), formats.load_mesh(made.path)
    viewer, number = walk_of(made)
    skinned = len(made.vertices)
    np.testing.assert_allclose(mesh.vertices[:skinned], made.vertices, rtol=0, atol=1e-5)
    np.testing.assert_allclose(mesh.weights.sum(axis=1), 1.0, atol=1e-9)
    assert len(mesh.vertices) == skinned + (8 if KINDS[kind].get("hat") else 0)
    for frame in (0, 11, motion.num_frames - 1):
        turns = rotations.to_matrix(motion.joint_rotations()[frame]).numpy()
        vertices, normals = mesh.pose(motion.joint_positions()[frame].numpy(), turns)
        wanted = viewer.skinned(number, frame / 30)
        near = 1e-5 if kind != "posed-nodes" else 2e-5
        np.testing.assert_allclose(vertices[:skinned], wanted, rtol=0, atol=near)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("interpolation", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("kind", ["mixamo", "unreal", "posed-nodes", "vrm"])
def test_animations_are_read(kind, interpolation, tmp_path):
    made = make(tmp_path, kind, animations=("walk", "other"), interpolation=interpolation)
    motion = formats.load(made.path)
    viewer, number = walk_of(made)
    assert (motion.fps, motion.num_frames) == (30, 31)
    for frame in range(0, 31, 6):
        for name, node in zip(made.names, made.nodes, strict=True):
            if name in motion.skeleton.names:
                place = motion.joint_positions()[frame, motion.skeleton.index(name)].numpy()
                np.testing.assert_allclose(place, viewer.world(node, number, frame / 30)[:3, 3], rtol=0, atol=5e-6)
    other = formats.load(f"{made.path}#/other")
    assert float((other.joint_positions() - motion.joint_positions()).abs().max()) > 0.01
    assert isinstance(other.source, CharacterSource)
    assert other.source.animation == "other"


@pytest.mark.parametrize("mirror", [(-1, -1, -1), (1, 1, -1)])
def test_a_last_joint_that_mirrors_is_read_and_written(mirror, tmp_path):
    made = make(tmp_path, "metres", animations=("walk",), leaves="none")
    plain, toes = formats.load(made.path), made.nodes[made.names.index(made.joint["leftToes"])]
    edit_glb(made.path, lambda tree: tree["nodes"][toes].update(scale=list(mirror)))
    motion = formats.load(made.path)
    torch.testing.assert_close(motion.joint_positions(), plain.joint_positions(), rtol=0, atol=1e-6)
    same = (motion.joint_rotations() * plain.joint_rotations()).sum(-1).abs()
    torch.testing.assert_close(same, torch.ones_like(same), rtol=0, atol=1e-6)
    motion.save(tmp_path / "new.glb")
    old, new = GlbViewer(made.path), GlbViewer(tmp_path / "new.glb")
    for frame in (0, 11, 30):
        np.testing.assert_allclose(new.world(toes, 0, frame / 30), old.world(toes, 0, frame / 30), atol=1e-5)


def test_of_several_animations_the_one_that_is_read_is_named(tmp_path, capsys):
    path = make(tmp_path, "metres", animations=("walk", "run")).path
    motion = formats.load(path)
    assert capsys.readouterr().err == (
        f"mapctl: {path}: reads 'walk', the first of 2 animations; choose another as 'hero.glb#/run'\n"
    )
    assert motion.source.animations == {"walk": pytest.approx(1.0), "run": pytest.approx(1.0)}
    assert list(motion.source.armatures) == [motion.source.armature]
    formats.load(f"{path}#/run")
    formats.load_rest(path)
    assert capsys.readouterr().err == ""


def test_an_animation_that_is_broken_and_not_read_is_passed_over(tmp_path):
    path = make(tmp_path, "metres", animations=("walk", "run")).path
    edit_glb(path, lambda tree: [sampler.update(input=9999) for sampler in tree["animations"][1]["samplers"]])
    assert list(formats.load(path).source.animations) == ["walk"]


def test_motion_is_read_where_a_material_is_broken(tmp_path, capsys):
    path = make(tmp_path, "metres", animations=("walk",)).path
    plain = formats.load(path)
    edit_glb(path, lambda tree: tree["materials"][0].update(pbrMetallicRoughness={"baseColorTexture": {"index": -1}}))
    torch.testing.assert_close(formats.load(path).joint_positions(), plain.joint_positions())
    err = capsys.readouterr().err
    assert err.startswith(f"mapctl: {path}: materials[0].pbrMetallicRoughness.baseColorTexture.index: ")
    assert err.endswith("; its joints and motion are read, its mesh is not\n")
    with pytest.raises(FileFormatError, match="carries no triangles"):
        formats.load_mesh(path)


def follow_up(made, frames=20):
    """A walk on the character that was made."""
    body = RiggedCharacter.of(figure.load_standing_character(made.path))[1]
    return body.on_rig(retarget_motion(walk(frames), body).motion)


def without_additions(tree):
    """All of a document but what an animation adds."""
    return {
        key: value for key, value in tree.items() if key not in ("animations", "accessors", "bufferViews", "buffers")
    }


@pytest.mark.slow
def test_a_motion_is_added_and_all_else_stays(kind, tmp_path):
    made = make(tmp_path, kind, animations=("walk",))
    motion = follow_up(made)
    out = tmp_path / f"new{made.path.suffix}"
    motion.save(out)
    (old, before), (new, after) = split_glb(made.path.read_bytes()), split_glb(out.read_bytes())
    assert after[: len(before)] == before
    if not KINDS[kind].get("matrices"):
        assert without_additions(old) == without_additions(new)
    for part in ("accessors", "bufferViews"):
        assert new[part][: len(old[part])] == old[part]
    assert [animation["name"] for animation in new["animations"]] == ["new", "walk"]
    viewer = GlbViewer(out)
    for frame in (0, 7, 19):
        for name in motion.skeleton.names:
            joint = motion.skeleton.index(name)
            node = int(motion.source.nodes[joint])
            place = motion.joint_positions()[frame, joint].numpy()
            np.testing.assert_allclose(viewer.world(node, 0, frame / 30)[:3, 3], place, rtol=0, atol=1e-5)
    again = formats.load(out)
    np.testing.assert_allclose(again.joint_positions().numpy(), motion.joint_positions().numpy(), rtol=0, atol=1e-5)


def test_soles_are_on_the_floor(kind, tmp_path):
    made = make(tmp_path, kind)
    standing = figure.load_standing_character(made.path)
    feet = [standing.skeleton.index(made.joint[side + "Foot"]) for side in ("left", "right")]
    shift = (
        standing.joint_positions()[0, feet, 1].numpy() - made.positions[[made.names.index(made.joint["leftFoot"])], 1]
    )
    lowest = made.vertices[:, 1].min()  # shoes are the lowest
    np.testing.assert_allclose(shift, -lowest, atol=1e-5)
    assert standing.num_frames == 30


def test_a_character_that_hovers_stands_on_its_soles(tmp_path):
    made = make(tmp_path, "vrm")
    edit_glb(made.path, lambda tree: tree["nodes"][0].update(translation=[0.0, 0.3, 0.0]))
    standing, hovering = figure.load_standing_character(made.path), formats.load_rest(made.path)
    head = standing.skeleton.index(made.joint["head"])
    there = made.positions[made.names.index(made.joint["head"]), 1]
    assert float(hovering.joint_positions()[0, head, 1]) == pytest.approx(there + 0.3, abs=1e-5)
    assert float(standing.joint_positions()[0, head, 1]) == pytest.approx(there - made.vertices[:, 1].min(), abs=1e-5)


def test_a_vrm_rests_as_its_nodes_stand(tmp_path):
    made = make(tmp_path, "vrm", pose="bent", node_pose="T")
    rest, viewer = formats.load_rest(made.path), GlbViewer(made.path)
    for name, node in zip(made.names, made.nodes, strict=True):
        if name in rest.skeleton.names:
            place = rest.joint_positions()[0, rest.skeleton.index(name)].numpy()
            np.testing.assert_allclose(place, viewer.world(node)[:3, 3], **POSITIONS)


def test_a_root_on_the_floor_stays_there(tmp_path):
    motion = follow_up(make(tmp_path, "unreal"))
    assert float(motion.joint_positions()[:, 0].abs().max()) < 1e-6
    hips = motion.joint_positions()[:, motion.skeleton.index("pelvis")]
    assert float(hips.diff(dim=0).norm(dim=-1).sum()) > 0.3


def test_a_pose_bound_in_the_armatures_space_is_the_rest_pose(tmp_path):
    made = make(tmp_path, "bound-in-armature", node_pose="bent")
    rest = formats.load_rest(made.path)
    at = [rest.skeleton.index(name) for name in made.names if name in rest.skeleton.names]
    told = [k for k, name in enumerate(made.names) if name in rest.skeleton.names]
    np.testing.assert_allclose(rest.joint_positions()[0, at].numpy(), made.positions[told], **POSITIONS)


def test_cubic_keys_are_hermite_splines():
    random = np.random.default_rng(0)
    times, keys = np.array([0.0, 0.5, 1.25, 1.5]), random.normal(size=(4, 3, 3))
    keys[:, 0] = keys[:, 2]  # one slope at a key, as scipy's have
    track = Track(0, "translation", times, keys.reshape(-1, 3), "CUBICSPLINE")
    at = np.linspace(0, 1.5, 23)
    wanted = CubicHermiteSpline(times, keys[:, 1], keys[:, 0])(at)
    np.testing.assert_allclose(sample_track(track, at), wanted, atol=1e-12)


def test_one_animation_is_replaced_where_it_was_the_one(tmp_path):
    made = make(tmp_path, "mixamo", animations=("walk", "wave"))
    motion = mapctl.load(f"{made.path}#/wave").slice(3, 20)
    motion.save(tmp_path / "cut.glb")
    tree, _ = split_glb((tmp_path / "cut.glb").read_bytes())
    assert [animation["name"] for animation in tree["animations"]] == ["cut", "walk"]
    again = formats.load(tmp_path / "cut.glb")
    np.testing.assert_allclose(again.joint_positions().numpy(), motion.joint_positions().numpy(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["mixamo", "vrm", "matrices", "aligned"])
def test_a_root_joint_is_added_to_the_character(kind, tmp_path):
    made = make(tmp_path, kind, animations=() if kind == "matrices" else ("walk",))
    motion = follow_up(made)
    rooted = editing.move_travel_to_root(motion)
    out = tmp_path / f"rooted{made.path.suffix}"
    rooted.save(out)
    again = formats.load(out)
    assert again.skeleton.names == rooted.skeleton.names == ("root", *motion.skeleton.names)
    np.testing.assert_allclose(
        again.joint_positions()[:, 1:].numpy(), motion.joint_positions().numpy(), rtol=0, atol=2e-5
    )
    np.testing.assert_allclose(again.joint_positions()[:, 0].numpy(), rooted.joint_positions()[:, 0].numpy(), atol=2e-5)
    viewer, old = GlbViewer(out), GlbViewer(made.path)
    assert len(viewer.nodes) == len(old.nodes) + 1
    np.testing.assert_allclose(viewer.skinned(), old.skinned(), atol=1e-6)  # the character as it stands is the same
    turns = rotations.to_matrix(motion.joint_rotations()[7]).numpy()
    wanted, _ = formats.load_mesh(made.path).pose(motion.joint_positions()[7].numpy(), turns)
    np.testing.assert_allclose(viewer.skinned(0, 7 / 30), wanted[: len(made.vertices)], rtol=0, atol=2e-5)


def test_other_files_are_put_into_the_one(tmp_path):
    (tmp_path / "in").mkdir()
    made = make_character_glb(tmp_path / "in" / "hero.gltf")
    motion = follow_up(made)
    motion.save(tmp_path / "out.glb")
    shutil.rmtree(tmp_path / "in")
    tree, binary = split_glb((tmp_path / "out.glb").read_bytes())
    assert "uri" not in json.dumps(tree)
    view = tree["bufferViews"][tree["images"][0]["bufferView"]]
    assert binary[view["byteOffset"] :][:4] == b"\x89PNG"
    mesh = formats.load_mesh(tmp_path / "out.glb")
    assert len(mesh.vertices) == len(made.vertices)
    assert len(np.unique(mesh.rgba.round(2), axis=0)) > 3


def test_the_same_motion_gives_the_same_bytes(tmp_path):
    motion = follow_up(make(tmp_path, "mixamo"))
    motion.save(tmp_path / "a.glb")
    first = (tmp_path / "a.glb").read_bytes()
    motion.save(tmp_path / "a.glb")
    assert (tmp_path / "a.glb").read_bytes() == first


def test_a_character_may_be_written_over_its_own_file(tmp_path):
    made = make(tmp_path, "mixamo")
    motion = follow_up(made)
    motion.save(made.path)
    np.testing.assert_allclose(
        formats.load(made.path).joint_positions().numpy(), motion.joint_positions().numpy(), rtol=0, atol=1e-5
    )
    with pytest.raises(RequestError, match="has changed since it was read"):
        motion.save(tmp_path / "late.glb")
    assert not (tmp_path / "late.glb").exists()


def test_a_vrm_needs_a_character(tmp_path):
    with pytest.raises(RequestError, match=r"a \.vrm needs a character"):
        random_motion(CANONICAL).save(tmp_path / "x.vrm")
    assert not list(tmp_path.iterdir())


def test_armatures_are_chosen_by_name(tmp_path):
    first = make(tmp_path, "mixamo", armature="Ann")
    second = make_character_glb(tmp_path / "second.glb", armature="Bob", size=1.5)
    path = _merge_files(tmp_path, first.path, second.path)
    with pytest.raises(FileFormatError, match=r"2 armatures: 'Ann_skin', 'Bob_skin'; choose one, as both.glb#Ann_skin"):
        formats.load(path)
    tall = formats.load_rest(f"{path}#Bob_skin")
    np.testing.assert_allclose(
        tall.joint_positions()[0, tall.skeleton.index("mixamorig:Head")].numpy(),
        second.positions[second.names.index("mixamorig:Head")],
        **POSITIONS,
    )
    motion = formats.load(f"{path}#Ann_skin")
    motion.save(tmp_path / "ann.glb")
    assert len(split_glb((tmp_path / "ann.glb").read_bytes())[0]["skins"]) == 2
    with pytest.raises(FileFormatError, match="no armature 'Eve'; it has 'Ann_skin', 'Bob_skin'"):
        formats.load(f"{path}#Eve")


def _merge_files(folder, *paths):
    """One file of several: each one's indices after those before."""
    whole, blob = {"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], "scene": 0}, b""
    for path in paths:
        tree, binary = split_glb(path.read_bytes())
        at = {
            key: len(whole.get(key, []))
            for key in ("nodes", "skins", "meshes", "accessors", "bufferViews", "materials")
        }
        for node in tree["nodes"]:
            node["children"] = [child + at["nodes"] for child in node.get("children", [])]
            for key, table in (("mesh", "meshes"), ("skin", "skins")):
                if key in node:
                    node[key] += at[table]
            if not node["children"]:
                del node["children"]
        for skin in tree["skins"]:
            skin["joints"] = [joint + at["nodes"] for joint in skin["joints"]]
            skin["inverseBindMatrices"] += at["accessors"]
            skin.pop("skeleton", None)
        for primitive in (p for mesh in tree["meshes"] for p in mesh["primitives"]):
            primitive["attributes"] = {k: v + at["accessors"] for k, v in primitive["attributes"].items()}
            primitive["indices"] += at["accessors"]
            primitive.pop("material", None)
        for accessor in tree["accessors"]:
            accessor["bufferView"] += at["bufferViews"]
        for view in tree["bufferViews"]:
            view["byteOffset"] = view.get("byteOffset", 0) + len(blob)
        for key in ("nodes", "skins", "meshes", "accessors", "bufferViews"):
            whole.setdefault(key, []).extend(tree[key])
        blob += binary + bytes(-len(binary) % 4)
    whole["buffers"] = [{"byteLength": len(blob)}]
    path = folder / "both.glb"
    path.write_bytes(join_glb(whole, blob))
    return path
