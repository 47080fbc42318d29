"""`mapctl info CLIP`: the clip's rig and joints, its unit and axes, its length."""

from pathlib import Path
from typing import Any

from mapctl import formats, report, retarget
from mapctl.commands.info import Info
from mapctl.commands.shared import inputs, outputs
from mapctl.commands.shared.tables import print_table
from mapctl.errors import RequestError
from mapctl.formats import bvh
from mapctl.formats.character import CharacterSource
from mapctl.formats.units import UNITS
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.doubts import Fit, assess_fit
from mapctl.skeleton import CANONICAL

_LISTS = ("joints", "known_by", "unmapped", "doubts", "fit", "skeletons", "animations")

_UNITS = {metres: name for name, metres in UNITS.items()}


def is_clip(name: str) -> bool:
    """Return whether the name is that of a motion file, by its ending."""
    return formats.ending_of(name) in formats.READERS


def print_clip(path: Path, command: Info) -> None:
    """Print a clip's description, and draw it where a picture is asked for.

    RequestError where the rig is not recognised, naming what is missing; what can be told of the clip is printed first.
    """
    picture, as_json = command.out, command.json
    outputs.check_picture(picture, given=path)
    given = inputs.read_rig(command.rig, command)
    motion = inputs.read_motion(path, given, quiet=True)
    try:
        rigmap = retarget.to_canonical(motion, given)[1]
    except RequestError as refusal:
        refused = {"file": str(path), "fit": "refused", "doubts": [str(refusal)], **_describe_file(motion)}
        _print({**refused, "joints": {}, "unmapped": list(motion.skeleton.names)}, as_json=as_json)
        raise
    fit = assess_fit(rigmap, motion)
    _print(describe_clip(path, motion, rigmap, fit), as_json=as_json)
    if picture is not None:
        from scenes import rig_picture

        rig_picture.plot_rig(rig_picture.RigPicture(rigmap, motion, fit, path.name), picture)


def describe_clip(path: Path, motion: Motion, rigmap: RigMap, fit: Fit) -> dict[str, Any]:
    """Describe a clip by name and value, as `mapctl info` prints it."""
    names = motion.skeleton.names
    joints = {c: None if j is None else names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True)}
    found = rigmap.match
    return {
        "file": str(path),
        "rig": rigmap.rig.name,
        "about": rigmap.rig.about,
        "score": round(found.score, 3),
        "fit": fit.verdict,
        "doubts": [doubt.reason for doubt in fit.doubts],
        "sides_exchanged": found.sides_exchanged,
        "rest_pose": rigmap.rest,
        "tpose_from": rigmap.tpose_from,
        "up": rigmap.up,
        "facing": rigmap.facing,
        **_describe_file(motion),
        "joints": joints,
        "known_by": {c: how.value for c, how in found.known_by.items() if joints[c]},
        "unmapped": list(found.unmapped),
    }


def _describe_file(motion: Motion) -> dict[str, Any]:
    """Describe what is known of a clip without its rig."""
    return {
        **({"licence": motion.licence} if motion.licence else {}),
        "metres_per_unit": bvh.unit_of(motion) or 1.0,
        "num_joints": motion.num_joints,
        "frames": motion.num_frames,
        "fps": float(motion.fps),
        "seconds": motion.seconds,
        **(_describe_choices(motion.source) if isinstance(motion.source, CharacterSource) else {}),
    }


def _describe_choices(source: CharacterSource) -> dict[str, Any]:
    """Describe the skeletons and animations of a character's file, which of them were read, and how each is chosen."""
    file, own = source.path.name, source.armature if len(source.armatures) > 1 else ""
    return {
        "skeletons": [
            {"name": name, "read": name == source.armature, "choose": f"{file}#{name}"} for name in source.armatures
        ],
        "animations": [
            {"name": name, "seconds": seconds, "read": name == source.animation, "choose": f"{file}#{own}/{name}"}
            for name, seconds in source.animations.items()
        ],
    }


def _print(described: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(report.to_json(described), end="")
        return
    shown = {key: value for key, value in described.items() if key not in _LISTS}
    shown["fps"] = f"{described['fps']:.6g}"
    shown["seconds"] = f"{described['seconds']:.2f}"
    shown["unit"] = _format_unit(described["metres_per_unit"])
    if "up" in described:
        shown["up"] = f"+{described['up']}" if len(described["up"]) == 1 else described["up"]
    del shown["metres_per_unit"]
    print_table(["clip", ""], [[key.replace("_", " "), str(value)] for key, value in shown.items()])
    for kind in ("skeletons", "animations"):
        rows = [
            [
                one["name"],
                f"{one['seconds']:.2f} s" if "seconds" in one else "",
                "read" if one["read"] else one["choose"],
            ]
            for one in described.get(kind, ())
        ]
        if rows:
            print_table([kind, "", "read, or chosen by"], rows)
    if described["joints"]:
        print_table(["canonical", "joint of the rig"], [[c, own] for c, own in described["joints"].items()])
    print(f"not canonical ({len(described['unmapped'])}): {', '.join(described['unmapped']) or 'none'}")
    print(f"fit: {described['fit']}")
    if described["fit"] == "doubtful":  # why a rig is refused, standard error says
        for reason in described["doubts"]:
            print(f"doubtful: {reason}")
        print(inputs.OVERRULE)


def _format_unit(metres: float) -> str:
    return f"{_UNITS[metres]} ({metres:g} m)" if metres in _UNITS else f"{metres:g} m"
