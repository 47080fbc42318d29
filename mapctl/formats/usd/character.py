"""USD out: a user's own character with an animation added; all else of its file stays as it is."""

from os import PathLike
from pathlib import Path

import numpy as np
import torch

from mapctl import rotations
from mapctl.formats.atomic import atomic_path
from mapctl.formats.characters.rest_frames import split_scale
from mapctl.formats.characters.source import CharacterSource
from mapctl.formats.text import MAX_FILE_BYTES
from mapctl.isolated.process import ask
from mapctl.motion import Motion

Array = np.ndarray


def save(motion: Motion, path: str | PathLike[str], source: CharacterSource) -> None:
    """Write the character's file with the motion, as an animation that is bound to its skeleton.

    Meshes, materials, skins, blend shapes and further prims stay as they are, and so do other animations; the one that
    the motion was read from is replaced. Layers that the file refers to stay files of their own where the new one lies
    in a folder that they are in; elsewhere, and of a .usdz, all becomes one layer. RequestError where the character's
    file has changed since it was read.
    """
    source.check_unchanged()
    moved, turned, scales = _locals(motion, source)
    prim = str(source.nodes[-1]).partition(".")[0]
    tables = {
        "translations": moved,
        "rotations": turned,
        "scales": scales,
        "places": motion.joint_positions().numpy(),
        "outer": source.frames.outer,
    }
    target = Path(path)
    request = {
        "wanted": "write",
        "skeleton": prim,
        "animation": source.animation,
        "stem": target.stem,
        "rate": float(motion.fps),
        "folder_out": str(target.resolve().parent),
        "most_bytes": MAX_FILE_BYTES,
    }
    with atomic_path(path) as scratch:
        found = ask("usd", source.path, {**request, "scratch": str(scratch)}, tables)
        if "unwritten" in found.said:
            raise OSError(found.said["unwritten"])


def _locals(motion: Motion, source: CharacterSource) -> tuple[Array, Array, Array]:
    """Return translations (frames, joints, 3), rotations (frames, joints, 4) and scales (joints, 3) of the file's
    joints in their parents' frames; of a root that the file does not have, its joints' part."""
    frames = source.frames
    moved, turned = frames.to_locals(motion)
    _, unit = split_scale(frames.outer)
    above = np.array([unit if parent < 0 else frames.scales[parent] for parent in frames.parents])
    scales = np.repeat((frames.scales / above)[:, None], 3, axis=1)
    if "." in str(source.nodes[0]):
        return moved, turned, scales
    roots = [joint for joint, parent in enumerate(frames.parents) if parent == 0]
    own = torch.from_numpy(turned[:, :1])
    moved[:, roots] = moved[:, :1] + rotations.rotate(own, torch.from_numpy(moved[:, roots])).numpy()
    turned[:, roots] = rotations.multiply(own.expand(-1, len(roots), -1), torch.from_numpy(turned[:, roots])).numpy()
    return moved[:, 1:], turned[:, 1:], scales[1:]
