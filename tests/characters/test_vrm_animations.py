"""VRM animations (.vrma): read, and written as VRMC_vrm_animation 1.0 asks for."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from character_maker import make_character_glb
from forged_characters import edit_glb, split_glb
from glb_viewer import GlbViewer
from helpers import random_motion, walk

from mapctl import formats
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.character import CharacterSource
from mapctl.skeleton import CANONICAL

EXTENSION = "VRMC_vrm_animation"
SIDES = ("left", "right")
REQUIRED = {"hips", "spine", "head"} | {
    side + part for side in SIDES for part in ("UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot")
}
"""Bones that a VRM humanoid must have."""


def make(folder, kind, **more):
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
    made = make(tmp_path, "vrm" if kind == "vrma" else kind, leaves="nodes")
    whole = formats.load(made.path)
    strip(made.path)
    path = made.path
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
    made = make(tmp_path, "mixamo", animations=())
    strip(made.path)
    with pytest.raises(FileFormatError, match="has no skin, no humanoid and no animation"):
        formats.load(made.path)


@pytest.mark.parametrize("kind", ["canonical", "vrm", "vrm0"])
def test_a_vrma_is_read_back(kind, tmp_path):
    out = tmp_path / "out.vrma"
    if kind == "canonical":
        motion = walk(20)
    else:
        whole = formats.load(make(tmp_path, kind).path)
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
def test_a_vrma_is_as_its_specification_says(kind, tmp_path):
    out = tmp_path / "out.vrma"
    (walk(5) if kind == "canonical" else formats.load(make(tmp_path, kind).path)).save(out)
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
    assert min(place[1] for place in at.values()) > -1e-6
    for side, sign in zip(SIDES, (1, -1), strict=True):
        assert sign * at[f"{side}UpperLeg"][0] > 0.03
        for inner, outer in pairwise(f"{side}{part}" for part in ("UpperArm", "LowerArm", "Hand")):
            along = at[outer] - at[inner]
            np.testing.assert_allclose(along / np.linalg.norm(along), (sign, 0, 0), atol=0.1)
        assert at[f"{side}Toes"][2] > at[f"{side}Foot"][2]


def test_bones_that_travel_are_noted(tmp_path, capsys):
    track = torch.full((5, 3), 0.3, dtype=torch.float64)
    replace(walk(5), moving_offsets={CANONICAL.index("leftHand"): track}).save(tmp_path / "out.vrma")
    assert "only the hips of a .vrma travel" in capsys.readouterr().err


def test_a_motion_whose_bones_are_not_known_is_refused(tmp_path):
    with pytest.raises(RequestError, match=r"a \.vrma needs the motion of a VRM or of canonical joints"):
        formats.load(make(tmp_path, "mixamo").path).save(tmp_path / "out.vrma")
