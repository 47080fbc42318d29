"""Rigs by commands: every command that writes motion, on every kind of file a character comes in, soles flat.

The quick run tries a cell of every row and of every column, `make test-all` all cells.
"""

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from character_maker import make_character_glb
from fbx_maker import make_fbx
from helpers import run
from rig_maker import Make, make, names_of

import mapctl
import priors
from controllers.shots.shot import follow
from mapctl import contacts, curves, formats, retarget
from mapctl.commands.shared import inputs
from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.skeleton import CANONICAL

_FEET, _TOES = ([CANONICAL.index(side + part) for side in ("left", "right")] for part in ("Foot", "Toes"))
_BVH = {
    "bandai-namco.bvh": Make(names_of("bandai-namco"), root="joint_Root"),
    "cmu-daz.bvh": Make(names_of("cmu-daz"), size=1.1),
    "cmu-asf.bvh": Make(names_of("cmu-asf"), bones_along_x=True, size=0.95),
    "lafan1.bvh": Make(names_of("lafan1"), bones_along_x=True),
    "mixamo.bvh": Make(names_of("mixamo"), arms_down_deg=45, zup=True),
    "iclone.bvh": Make(names_of("iclone"), arms_down_deg=30, size=1.2),
}
_CHARACTERS = {
    "mixamo.glb": {"pose": "A", "leaves": "joints"},
    "unreal.glb": {"names": "unreal", "root": "root", "pose": "A", "size": 1.2},
    "vroid.vrm": {"names": "vrm", "armature_scale": 1.0, "zup_armature": False, "size": 0.85},
    "old.vrm": {"names": "vrm0", "armature_scale": 1.0, "zup_armature": False},
}
RIGS = (*_BVH, *_CHARACTERS, "body.usda", "limbs.fbx")
COMMANDS = ("follow", "generate", "steer", "convert", "denoise", "infill", "tween")


@dataclass(frozen=True)
class Rig:
    """A rig's file, and a walk on it in a file of the same kind."""

    file: Path
    clip: Path
    body: RiggedCharacter


@pytest.fixture(scope="module")
def walked() -> Motion:
    """Three seconds of the bundled prior's walking, straight and round a bend."""
    generator = torch.Generator().manual_seed(1)
    return follow(priors.load("locomotion"), curves.circle(radius=3.0), seconds=3, generator=generator).motion


@pytest.fixture(scope="module")
def rigs(walked, tmp_path_factory):
    """Each rig's files, made when they are asked for."""
    made: dict[str, Rig] = {}

    def find(name: str) -> Rig:
        if name not in made:
            folder = tmp_path_factory.mktemp(name.replace(".", "-"))
            file = clip = folder / name
            if name == "body.usda":
                pytest.importorskip("pxr")
                make_character_usd = import_module("usd_maker").make_character_usd
                make_character_usd(file, up="Z", unit=0.01)
                clip = folder / "walk.usda"
            elif name == "limbs.fbx":
                pytest.importorskip("ufbx")
                make_fbx(file, z_up=True)
                clip = folder / "walk.glb"
            elif name in _BVH:
                sized = replace(walked, root_position=walked.root_position * _BVH[name].size)
                make(_BVH[name]).motion(sized).save(file)
            else:
                make_character_glb(file, **_CHARACTERS[name])
                clip = folder / f"walk-{name}"
            body = RiggedCharacter.of(*inputs.read_rig_clip(str(file)))[1]
            if clip != file:
                body.on_rig(retarget_motion(walked, body).motion).save(clip)
            made[name] = Rig(file, clip, body)
        return made[name]

    return find


def foot_pitches(motion: Motion) -> np.ndarray:
    """Slope of the line from ankle to toe joint, degrees, of the left and right foot, while it lies flat."""
    canonical, _ = retarget.to_canonical(motion)
    positions = canonical.joint_positions()
    planted = contacts.detect_contacts(positions[:, _TOES], canonical.fps)
    found = []
    for side in range(2):
        ankle, toe = positions[:, _FEET[side]], positions[:, _TOES[side]]
        low = ankle[:, 1] < torch.quantile(ankle[planted[:, side], 1], 0.1) + 0.01
        along = (toe - ankle)[planted[:, side] & low]
        found.append(float(torch.rad2deg(torch.atan2(along[:, 1], along[:, ::2].norm(dim=-1))).median()))
    return np.array(found)


def standing_pitches(rig: Rig) -> np.ndarray:
    """The same in the pose in which a character stands, or as it lies in the rig's own clip."""
    if formats.load_rest(rig.file) is None:
        return foot_pitches(mapctl.load(rig.file))
    canonical, _ = retarget.to_canonical(inputs.read_rig_clip(str(rig.file))[0])
    along = canonical.joint_positions()[0, _TOES] - canonical.joint_positions()[0, _FEET]
    return torch.rad2deg(torch.atan2(along[:, 1], along[:, ::2].norm(dim=-1))).numpy()


def words_of(command: str, rig: Rig, out: Path, walked: Motion) -> list[object]:
    """A command on a rig that writes `out`."""
    folder = out.parent
    if command == "convert":
        walked.save(folder / "walked.npz")
    if command == "steer":
        (folder / "orders.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n1.5,1.2,40\n3,1.2,40\n")
    return {
        "follow": ["follow", "circle:3", "-o", out, "--seconds", "3", "--rig", rig.file, "--quiet"],
        "generate": ["generate", "-o", folder, "--seconds", "3", "--rig", rig.file, "--to", out.suffix, "--quiet"],
        "steer": ["steer", folder / "orders.csv", "-o", out, "--rig", rig.file, "--quiet"],
        "convert": ["convert", folder / "walked.npz", out, "--rig", rig.file],
        "denoise": ["denoise", rig.clip, "-o", out],
        "infill": ["infill", rig.clip, "-o", out, "--gap", "30:55"],
        "tween": ["tween", rig.clip, "-o", out, "--keyframes", "0,15,30,45,60,75,89"],
    }[command]


def cells():
    """All rigs by all commands; quick ones on the diagonal."""
    for row, rig in enumerate(RIGS):
        for column, command in enumerate(COMMANDS):
            quick = column == row % len(COMMANDS)
            yield pytest.param(rig, command, marks=() if quick else pytest.mark.slow, id=f"{rig}-{command}")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "command"), [*cells()])
def test_every_command_on_every_rig(name, command, rigs, walked, tmp_path, capsys):
    rig = rigs(name)
    out = tmp_path / f"out{rig.clip.suffix}"  # an FBX character comes back as .glb, with its mesh
    assert run(*words_of(command, rig, out, walked)) == 0, capsys.readouterr().err
    made = mapctl.load(tmp_path / f"generated_000{out.suffix}" if command == "generate" else out)
    expected = rig.body.rigmap.rig_skeleton
    assert (made.skeleton.names, made.skeleton.parents) == (expected.names, expected.parents)
    assert made.num_frames >= 89
    np.testing.assert_allclose(foot_pitches(made), standing_pitches(rig), atol=5.0)
    toes = retarget.to_canonical(made)[0].joint_positions()[:, _TOES, 1]
    low = torch.quantile(toes, 0.05, dim=0)
    torch.testing.assert_close(low, rig.body.stance.toe_height, atol=0.015, rtol=0)
    steps = made.joint_positions().diff(dim=0).norm(dim=-1)
    assert float(steps.max()) * float(made.fps) < 9.0
