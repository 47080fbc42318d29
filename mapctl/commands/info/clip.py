"""`mapctl info CLIP`: the clip's rig and joints, its unit and axes, its length."""

from pathlib import Path
from typing import Any

from mapctl import formats, report, retarget
from mapctl.commands.shared import inputs
from mapctl.commands.shared.tables import print_table
from mapctl.formats import bvh
from mapctl.skeleton import CANONICAL

_UNITS = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres", 0.0254: "inches"}


def is_clip(name: str) -> bool:
    """Return whether the name is that of a motion file, by its ending."""
    return Path(name).suffix.lower() in formats.READERS


def print_clip(path: Path, rig: str | None, *, as_json: bool) -> None:
    """Print a clip's description; RequestError where the rig is not recognised, naming what is missing."""
    described = describe_clip(path, rig)
    if as_json:
        print(report.to_json(described), end="")
        return
    shown = {key: value for key, value in described.items() if key not in ("joints", "unmapped")}
    shown["fps"] = f"{described['fps']:.6g}"
    shown["seconds"] = f"{described['seconds']:.2f}"
    shown["unit"] = _format_unit(described["metres_per_unit"])
    shown["up"] = f"+{described['up']}" if len(described["up"]) == 1 else described["up"]
    del shown["metres_per_unit"]
    print_table(["clip", ""], [[key.replace("_", " "), str(value)] for key, value in shown.items()])
    print_table(["canonical", "joint of the rig"], [[c, own] for c, own in described["joints"].items()])
    print(f"not canonical ({len(described['unmapped'])}): {', '.join(described['unmapped']) or 'none'}")


def describe_clip(path: Path, rig_text: str | None) -> dict[str, Any]:
    """Describe a clip by name and value, as `mapctl info` prints it."""
    rig = inputs.read_rig(rig_text)
    motion = inputs.read_motion(path, rig)
    rigmap = retarget.to_canonical(motion, rig)[1]
    names = motion.skeleton.names
    joints = {c: None if j is None else names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True)}
    found = rigmap.match
    return {
        "file": str(path),
        "rig": rigmap.rig.name,
        "about": rigmap.rig.about,
        "score": 1.0 if found is None else round(found.score, 3),
        "sides_exchanged": found is not None and found.sides_exchanged,
        "rest_pose": rigmap.rest,
        "tpose_from": rigmap.tpose_from,
        "up": rigmap.up,
        "facing": rigmap.facing,
        "metres_per_unit": bvh.unit_of(motion) or 1.0,
        "num_joints": motion.num_joints,
        "frames": motion.num_frames,
        "fps": float(motion.fps),
        "seconds": motion.seconds,
        "joints": joints,
        "unmapped": [] if found is None else list(found.unmapped),
    }


def _format_unit(metres: float) -> str:
    return f"{_UNITS[metres]} ({metres:g} m)" if metres in _UNITS else f"{metres:g} m"
