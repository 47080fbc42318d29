"""FBX out, by Blender's exporter in a process of its own: the program `blender`, or a Python with the package bpy."""

import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from os import PathLike
from pathlib import Path

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats.atomic import atomic_path
from mapctl.formats.character import build_skinned_body, character_of
from mapctl.formats.text import one_line
from mapctl.motion import Motion

BLENDER = "MAPCTL_BLENDER"
"""Environment variable that names a Blender, or a Python with bpy."""
_SCRIPT = str(Path(__file__).resolve().parents[1] / "blender" / "write_fbx.py")
NEEDED = (
    "FBX is written by Blender: install it from blender.org and put its program on PATH, or name it, or a Python with"
    f" the package bpy, by the environment variable {BLENDER}; or write .glb, .usda or .bvh"
)


def find_blender() -> list[str]:
    """Find the words that start a script in Blender; RequestError where there is no Blender."""
    named = os.environ.get(BLENDER) or (sys.executable if find_spec("bpy") else "blender")
    program = shutil.which(named)
    if program is None:
        raise RequestError(NEEDED if named == "blender" else f"{BLENDER} names {named}, which is no program")
    if Path(program).name.lower().startswith("python"):
        return [program, _SCRIPT]
    return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", _SCRIPT, "--"]


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion: on the character whose file its skeleton came from, else on a mannequin.

    Of the character's file Blender imports and exports joints, meshes, skins and materials; its animations are left
    out. RequestError where the character's file has changed since it was read, or Blender cannot write it.
    """
    source = character_of(motion, ".fbx")
    turns = motion.joint_rotations()
    if source is None:
        character = _describe_body(motion)
    else:
        turns = rotations.multiply(turns, torch.from_numpy(source.frames.quat_xyzw))
        character = {"character": str(source.path), "armature": source.armature}
    with atomic_path(path) as scratch, tempfile.TemporaryDirectory() as folder:
        request = Path(folder) / "request.npz"
        np.savez(
            request,
            allow_pickle=False,
            names=np.array(motion.skeleton.names),
            fps=np.array([motion.fps.numerator, motion.fps.denominator]),
            rotations=rotations.to_matrix(turns).numpy(),
            positions=motion.joint_positions().numpy(),
            name=np.array(Path(path).stem),
            out=np.array(os.fspath(scratch)),
            **{key: np.asarray(value) for key, value in character.items()},
        )
        done = subprocess.run([*find_blender(), str(request)], capture_output=True, stdin=subprocess.DEVNULL)
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        if done.returncode != 0 or not scratch.stat().st_size:
            reason = lines[-1] if lines else f"Blender ends with status {done.returncode}"
            raise RequestError(f"cannot write {path}: {one_line(reason)}")


def _describe_body(motion: Motion) -> dict[str, object]:
    """Return the arrays of a skeleton and its skinned body at rest, metres."""
    skeleton = motion.skeleton
    rest = Motion.at_rest(skeleton).joint_positions()[0].numpy()
    name, body = build_skinned_body(motion)
    vertices, _ = body.pose(rest, np.tile(np.eye(3), (len(rest), 1, 1)))
    return {
        "parents": skeleton.parents,
        "rest": rest,
        "end_names": np.array(list(skeleton.end_offsets), dtype=np.str_),
        "end_offsets": np.array(list(skeleton.end_offsets.values()), dtype=np.float64).reshape(-1, 3),
        "mesh": name,
        "vertices": vertices,
        "faces": body.faces,
        "rgba": body.rgba,
        "joints": body.joints,
        "weights": body.weights,
    }
