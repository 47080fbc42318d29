"""glTF, VRM and VRM animations: read as rigs and clips, and written back, as a viewer of their own sees them."""

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from character_maker import make_character_glb
from glb_viewer import GlbViewer
from helpers import random_motion, walk

import mapctl
from mapctl import editing, formats, retarget, rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.character import CharacterSource
from mapctl.mesh.mannequin import build_skin
from mapctl.retarget import character
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.skeleton import CANONICAL

KINDS = {
    "mixamo": {},
    "posed-nodes": {"pose": "T", "node_pose": "bent"},
    "matrices": {"matrices": True, "pose": "A"},
    "unreal": {"names": "unreal", "root": "root", "leaves": "none", "pose": "A"},
    "metres": {"armature_scale": 1.0, "zup_armature": False, "names": "readyplayer"},
    "two-skins": {"second_skin": True, "hat": True, "extra_nodes": True},
    "compact": {"compact": True, "morphs": 2, "size": 1.3},
    "vrm": {"names": "vrm", "armature_scale": 1.0, "zup_armature": False},
    "vrm0": {"names": "vrm0", "armature_scale": 1.0, "zup_armature": False, "size": 0.8},
}


POSITIONS = dict(rtol=0, atol=2e-6)


def make(folder, kind, **more):
    ending = ".vrm" if kind.startswith("vrm") else ".glb"
    return make_character_glb(folder / f"hero{ending}", **(KINDS[kind] | more))


def walk_of(result):
    """The animation's joints and skinned vertices over its frames, by the viewer."""
    viewer = GlbViewer(result.path)
    number = viewer.animation(result.animations[0])
    return viewer, number


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def split_glb(raw: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of a sound .glb."""
    size = struct.unpack_from("<I", raw, 12)[0]
    rest = raw[20 + size :]
    return json.loads(raw[20 : 20 + size]), rest[8 : 8 + struct.unpack_from("<I", rest)[0]] if rest else b""


def join_glb(tree: Any, binary: bytes) -> bytes:
    """A .glb of a document, a tree or its text, and a binary chunk."""
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def edit_glb(path: Path, change: Callable[[Any], object]) -> None:
    """Write the .glb with another document: CHANGE is given the old one to alter."""
    tree, binary = split_glb(path.read_bytes())
    change(tree)
    path.write_bytes(join_glb(tree, binary))


def test_the_rest_pose_is_the_bound_one(kind, tmp_path):
    result = make(tmp_path, kind)
    rest = formats.load_rest(result.path)
    at = [rest.skeleton.index(name) for name in result.names if name in rest.skeleton.names]
    given = [k for k, name in enumerate(result.names) if name in rest.skeleton.names]
    assert len(given) >= 22
    np.testing.assert_allclose(rest.joint_positions()[0, at].numpy(), result.positions[given], **POSITIONS)
    assert float(rest.local_quat_xyzw[..., 3].abs().min()) == pytest.approx(1.0)


def test_joints_are_recognised(kind, tmp_path):
    result = make(tmp_path, kind)
    rest = formats.load_rest(result.path)
    canonical, rigmap = retarget.to_canonical(rest)
    wanted = {joint: name for joint, name in result.joint.items() if joint in CANONICAL.names}
    assert rigmap.joint_names == wanted
    assert rigmap.up == "y"
    assert rigmap.facing == ("-z" if kind == "vrm0" else "z")
    # standing in the T-pose: hands far to their sides, at shoulder height where the file says T
    left = canonical.skeleton.offsets[CANONICAL.index("leftLowerArm")]
    torch.testing.assert_close(left / left.norm(), torch.tensor([1.0, 0, 0]).double(), atol=1e-6, rtol=0)
    assert rigmap.rest == ("A" if KINDS[kind].get("pose") == "A" else "T")


def test_meshes_are_where_a_viewer_draws_them(kind, tmp_path):
    result = make(tmp_path, kind, animations=("walk",))
    motion, mesh = formats.load(result.path), formats.load_mesh(result.path)
    viewer, number = walk_of(result)
    skinned = len(result.vertices)
    np.testing.assert_allclose(mesh.vertices[:skinned], result.vertices, rtol=0, atol=1e-5)
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
@pytest.mark.parametrize("kind", ["posed-nodes"])
def test_animations_are_read(kind, interpolation, tmp_path):
    result = make(tmp_path, kind, animations=("walk", "other"), interpolation=interpolation)
    motion = formats.load(result.path)
    viewer, number = walk_of(result)
    assert (motion.fps, motion.num_frames) == (30, 31)
    for frame in range(0, 31, 6):
        for name, node in zip(result.names, result.nodes, strict=True):
            if name in motion.skeleton.names:
                position = motion.joint_positions()[frame, motion.skeleton.index(name)].numpy()
                np.testing.assert_allclose(position, viewer.world(node, number, frame / 30)[:3, 3], rtol=0, atol=5e-6)
    other = formats.load(f"{result.path}#/other")
    assert float((other.joint_positions() - motion.joint_positions()).abs().max()) > 0.01
    assert isinstance(other.source, CharacterSource)
    assert other.source.animation == "other"


@pytest.mark.parametrize("mirror", [(1, 1, -1)])
def test_a_last_joint_that_mirrors_is_read_and_written(mirror, tmp_path):
    result = make(tmp_path, "metres", animations=("walk",), leaves="none")
    plain, toes = formats.load(result.path), result.nodes[result.names.index(result.joint["leftToes"])]
    edit_glb(result.path, lambda tree: tree["nodes"][toes].update(scale=list(mirror)))
    motion = formats.load(result.path)
    torch.testing.assert_close(motion.joint_positions(), plain.joint_positions(), rtol=0, atol=1e-6)
    same = (motion.joint_rotations() * plain.joint_rotations()).sum(-1).abs()
    torch.testing.assert_close(same, torch.ones_like(same), rtol=0, atol=1e-6)
    motion.save(tmp_path / "new.glb")
    old, new = GlbViewer(result.path), GlbViewer(tmp_path / "new.glb")
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


def follow_up(result, frames=20):
    """A walk on the character that was made."""
    body = RiggedCharacter.of(character.load_standing_character(result.path))[1]
    return body.on_rig(retarget_motion(walk(frames), body).motion)


def without_additions(tree):
    """All of a document but what an animation adds."""
    return {
        key: value for key, value in tree.items() if key not in ("animations", "accessors", "bufferViews", "buffers")
    }


@pytest.mark.slow
def test_a_motion_is_added_and_all_else_stays(kind, tmp_path):
    result = make(tmp_path, kind, animations=("walk",))
    motion = follow_up(result)
    out = tmp_path / f"new{result.path.suffix}"
    motion.save(out)
    (old, before), (new, after) = split_glb(result.path.read_bytes()), split_glb(out.read_bytes())
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
            position = motion.joint_positions()[frame, joint].numpy()
            np.testing.assert_allclose(viewer.world(node, 0, frame / 30)[:3, 3], position, rtol=0, atol=1e-5)
    again = formats.load(out)
    np.testing.assert_allclose(again.joint_positions().numpy(), motion.joint_positions().numpy(), rtol=0, atol=1e-5)


def test_a_vrm_rests_as_its_nodes_stand(tmp_path):
    result = make(tmp_path, "vrm", pose="bent", node_pose="T")
    rest, viewer = formats.load_rest(result.path), GlbViewer(result.path)
    for name, node in zip(result.names, result.nodes, strict=True):
        if name in rest.skeleton.names:
            position = rest.joint_positions()[0, rest.skeleton.index(name)].numpy()
            np.testing.assert_allclose(position, viewer.world(node)[:3, 3], **POSITIONS)


def test_one_animation_is_replaced_where_it_was_the_one(tmp_path):
    result = make(tmp_path, "mixamo", animations=("walk", "wave"))
    motion = mapctl.load(f"{result.path}#/wave").slice(3, 20)
    motion.save(tmp_path / "cut.glb")
    tree, _ = split_glb((tmp_path / "cut.glb").read_bytes())
    assert [animation["name"] for animation in tree["animations"]] == ["cut", "walk"]
    again = formats.load(tmp_path / "cut.glb")
    np.testing.assert_allclose(again.joint_positions().numpy(), motion.joint_positions().numpy(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["matrices", "vrm"])
def test_a_root_joint_is_added_to_the_character(kind, tmp_path):
    result = make(tmp_path, kind, animations=() if kind == "matrices" else ("walk",))
    motion = follow_up(result)
    rooted = editing.move_travel_to_root(motion)
    out = tmp_path / f"rooted{result.path.suffix}"
    rooted.save(out)
    again = formats.load(out)
    assert again.skeleton.names == rooted.skeleton.names == ("root", *motion.skeleton.names)
    np.testing.assert_allclose(
        again.joint_positions()[:, 1:].numpy(), motion.joint_positions().numpy(), rtol=0, atol=2e-5
    )
    np.testing.assert_allclose(again.joint_positions()[:, 0].numpy(), rooted.joint_positions()[:, 0].numpy(), atol=2e-5)
    viewer, old = GlbViewer(out), GlbViewer(result.path)
    assert len(viewer.nodes) == len(old.nodes) + 1
    np.testing.assert_allclose(viewer.skinned(), old.skinned(), atol=1e-6)  # the character as it stands is the same
    turns = rotations.to_matrix(motion.joint_rotations()[7]).numpy()
    wanted, _ = formats.load_mesh(result.path).pose(motion.joint_positions()[7].numpy(), turns)
    np.testing.assert_allclose(viewer.skinned(0, 7 / 30), wanted[: len(result.vertices)], rtol=0, atol=2e-5)


def test_other_files_are_put_into_the_one(tmp_path):
    (tmp_path / "in").mkdir()
    result = make_character_glb(tmp_path / "in" / "hero.gltf")
    motion = follow_up(result)
    motion.save(tmp_path / "out.glb")
    shutil.rmtree(tmp_path / "in")
    tree, binary = split_glb((tmp_path / "out.glb").read_bytes())
    assert "uri" not in json.dumps(tree)
    view = tree["bufferViews"][tree["images"][0]["bufferView"]]
    assert binary[view["byteOffset"] :][:4] == b"\x89PNG"
    mesh = formats.load_mesh(tmp_path / "out.glb")
    assert len(mesh.vertices) == len(result.vertices)
    assert len(np.unique(mesh.rgba.round(2), axis=0)) > 3


def test_a_character_may_be_written_over_its_own_file(tmp_path):
    result = make(tmp_path, "mixamo")
    motion = follow_up(result)
    motion.save(result.path)
    np.testing.assert_allclose(
        formats.load(result.path).joint_positions().numpy(), motion.joint_positions().numpy(), rtol=0, atol=1e-5
    )
    with pytest.raises(RequestError, match="has changed since it was read"):
        motion.save(tmp_path / "late.glb")
    assert not (tmp_path / "late.glb").exists()


EXTENSION = "VRMC_vrm_animation"


SIDES = ("left", "right")


REQUIRED = {"hips", "spine", "head"} | {
    side + part for side in SIDES for part in ("UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot")
}
"""Bones that a VRM humanoid must have."""


def make_animated(folder, kind, **more):
    path = folder / ("hero.vrm" if kind.startswith("vrm") else "hero.glb")
    usual = {"armature_scale": 1.0, "zup_armature": False, "animations": ("walk", "run"), "frames": 20}
    return make_character_glb(path, names=kind, **(usual | more))


def strip(path):
    """Remove what is drawn from a file: skins, meshes and their looks."""

    def change(tree):
        for unused in ("skins", "meshes", "materials", "textures", "images"):
            tree.pop(unused, None)
        for node in tree["nodes"]:
            node.pop("mesh", None)
            node.pop("skin", None)

    edit_glb(path, change)


def places_of(motion, names):
    return motion.joint_positions()[:, [motion.skeleton.index(name) for name in names]]


@pytest.mark.parametrize("kind", ["vrm", "vrm0", "mixamo", "unreal", "vrma"])
def test_files_without_a_skin_are_read(kind, tmp_path):
    result = make_animated(tmp_path, "vrm" if kind == "vrma" else kind, leaves="nodes")
    whole = formats.load(result.path)
    strip(result.path)
    path = result.path
    if kind == "vrma":
        edit_glb(path, lambda tree: tree.update(extensions={EXTENSION: tree["extensions"]["VRMC_vrm"]}))
        path = path.rename(tmp_path / "hero.vrma")
    bare = formats.load(path)
    assert (bare.num_frames, bare.fps) == (whole.num_frames, whole.fps)
    names = [name for name in whole.skeleton.names if name in bare.skeleton.names]
    assert len(names) >= 21
    torch.testing.assert_close(places_of(bare, names), places_of(whole, names), rtol=0, atol=1e-5)
    assert bare.source.humanoid == whole.source.humanoid
    assert formats.load_rest(path).num_frames == 1


def test_a_bare_file_without_an_animation_is_refused(tmp_path):
    result = make_animated(tmp_path, "mixamo", animations=())
    strip(result.path)
    with pytest.raises(FileFormatError, match="has no skin, no humanoid and no animation"):
        formats.load(result.path)


@pytest.mark.parametrize("kind", ["canonical", "vrm", "vrm0"])
def test_a_vrma_is_read_back(kind, tmp_path):
    out = tmp_path / "out.vrma"
    if kind == "canonical":
        motion = walk(20)
    else:
        whole = formats.load(make_animated(tmp_path, kind).path)
        motion = replace(random_motion(whole.skeleton, 20), source=whole.source)
    motion.save(out)
    again = formats.load(out)
    assert (again.fps, again.num_frames) == (motion.fps, motion.num_frames)
    wanted = places_of(motion, again.skeleton.names)
    if kind == "vrm0":  # it faces -Z, a VRM animation +Z
        wanted = wanted * torch.tensor([-1.0, 1.0, -1.0])
    torch.testing.assert_close(again.joint_positions(), wanted, rtol=0, atol=1e-5)
    assert isinstance(again.source, CharacterSource)
    joints = {name: name for name in CANONICAL.names} if kind == "canonical" else motion.source.humanoid
    assert again.source.humanoid == joints
    again.save(tmp_path / "again.vrma")
    torch.testing.assert_close(
        formats.load(tmp_path / "again.vrma").joint_positions(), again.joint_positions(), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("kind", ["canonical", "vrm", "vrm0"])
def test_a_vrma_follows_its_specification(kind, tmp_path):
    out = tmp_path / "out.vrma"
    (walk(5) if kind == "canonical" else formats.load(make_animated(tmp_path, kind).path)).save(out)
    tree, _ = split_glb(out.read_bytes())
    assert tree["extensionsUsed"] == [EXTENSION]
    said = tree["extensions"][EXTENSION]
    assert said["specVersion"] == "1.0"
    bones = {bone: found["node"] for bone, found in said["humanoid"]["humanBones"].items()}
    assert bones.keys() >= REQUIRED
    assert not {"leftEye", "rightEye"} & bones.keys()
    assert not {"meshes", "skins", "materials"} & tree.keys()
    targets = [channel["target"] for channel in tree["animations"][0]["channels"]]
    assert {target["path"] for target in targets} == {"translation", "rotation"}
    assert [target["node"] for target in targets if target["path"] == "translation"] == [bones["hips"]]
    assert not any("scale" in node or "rotation" in node for node in tree["nodes"])
    viewer = GlbViewer(out)
    at = {bone: viewer.world(node)[:3, 3] for bone, node in bones.items()}
    assert min(position[1] for position in at.values()) > -1e-6
    for side, sign in zip(SIDES, (1, -1), strict=True):
        assert sign * at[f"{side}UpperLeg"][0] > 0.03
        for inner, outer in pairwise(f"{side}{part}" for part in ("UpperArm", "LowerArm", "Hand")):
            along = at[outer] - at[inner]
            np.testing.assert_allclose(along / np.linalg.norm(along), (sign, 0, 0), atol=0.1)
        assert at[f"{side}Toes"][2] > at[f"{side}Foot"][2]


def test_a_motion_with_unknown_bones_is_refused(tmp_path):
    with pytest.raises(RequestError, match=r"a \.vrma needs the motion of a VRM or of canonical joints"):
        formats.load(make_animated(tmp_path, "mixamo").path).save(tmp_path / "out.vrma")


def test_the_mannequin_moves_as_the_motion(tmp_path):
    motion = random_motion(CANONICAL, 12, seed=4)
    motion.save(tmp_path / "a.glb")
    viewer, body = GlbViewer(tmp_path / "a.glb"), build_skin(motion)
    matrices, positions = rotations.to_matrix(motion.joint_rotations()).numpy(), motion.joint_positions().numpy()
    for frame in (0, 7, 11):
        for joint, name in enumerate(CANONICAL.names):
            world = viewer.world(viewer.node(name), 0, frame / 30)
            np.testing.assert_allclose(world[:3, 3], positions[frame, joint], atol=2e-6)
        expected, _ = body.pose(positions[frame], matrices[frame])
        np.testing.assert_allclose(viewer.skinned(0, frame / 30), expected, atol=5e-6)


def hips_of(result):
    return result.nodes[result.names.index("mixamorig:Hips")]


BROKEN = {
    "no skin": (lambda t, m: t.pop("skins"), "has no skin"),
    "non-uniform scale": (lambda t, m: t["nodes"][0].update(scale=[0.01, 0.02, 0.01]), "not the same along all axes"),
    "negative scale": (lambda t, m: t["nodes"][0].update(scale=[-0.01, 0.01, 0.01]), "negative, which mirrors"),
    "no scale": (lambda t, m: t["nodes"][0].update(scale=[0, 0, 0]), "zero"),
    "draco": (lambda t, m: t.update(extensionsRequired=["KHR_draco_mesh_compression"]), "compressed .KHR_draco"),
    "meshopt": (lambda t, m: t.update(extensionsRequired=["EXT_meshopt_compression"]), "compressed .EXT_meshopt"),
    "missing buffer": (lambda t, m: t["buffers"][0].update(byteLength=2**28), "should have 268435456 bytes, there are"),
    "file that is not there": (lambda t, m: t["buffers"][0].update(uri="gone.bin"), "'gone.bin', which is not there"),
    "file elsewhere": (lambda t, m: t["buffers"][0].update(uri="../x.bin"), "'../x.bin', which is not in its folder"),
    "absolute file": (lambda t, m: t["buffers"][0].update(uri="/etc/passwd"), "which is not in its folder"),
    "web address": (lambda t, m: t["buffers"][0].update(uri="https://host/x.bin"), "which is not in its folder"),
    "glTF 1": (lambda t, m: t["asset"].update(version="1.0"), "is glTF '1.0', expected 2.0"),
    "loop": (lambda t, m: t["nodes"][hips_of(m)].setdefault("children", []).append(0), "below itself"),
    "two parents": (lambda t, m: t["nodes"][0]["children"].append(hips_of(m) + 1), "has two parents"),
    "words": (lambda t, m: t["nodes"][0].update(translation=[0, "x", 0]), "is no sound glTF file: ValueError"),
    "no list": (lambda t, m: t.update(skins=7), "is no sound glTF file"),
    "accessor beyond": (lambda t, m: t["skins"][0].update(inverseBindMatrices=999), r"has no accessors\[999\]"),
    "half a letter": (lambda t, m: t["nodes"][0].update(name="\ud800"), "its JSON cannot be read"),
    "joint beyond": (lambda t, m: t["skins"][0]["joints"].append(999), "has no nodes.999"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_faults_are_reported_in_a_line(fault, tmp_path):
    result = make(tmp_path, "mixamo")
    change, given = BROKEN[fault]
    edit_glb(result.path, lambda tree: change(tree, result))
    with pytest.raises(FileFormatError, match=given) as caught:
        formats.load(result.path)
    assert "\n" not in str(caught.value)
    assert str(result.path) in str(caught.value)


def test_neighbours_within_the_folder_are_read(tmp_path):
    result = make_character_glb(tmp_path / "hero.gltf")
    (tmp_path / "below").mkdir()
    tree = json.loads(result.path.read_text())
    name = tree["buffers"][0]["uri"]
    (tmp_path / name).rename(tmp_path / "below" / "the data.bin")
    tree["buffers"][0]["uri"] = "below/the%20data.bin"
    result.path.write_text(json.dumps(tree))
    assert formats.load_rest(result.path).num_joints > 20
    link = tmp_path / "out.bin"
    outside = tmp_path.parent / f"{tmp_path.name}.bin"
    shutil.move(tmp_path / "below" / "the data.bin", outside)
    link.symlink_to(outside)
    tree["buffers"][0]["uri"] = "out.bin"
    result.path.write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match="not in its folder"):
        formats.load(result.path)
