"""A picture of a rig as it was understood: its T-pose with both names of each joint, frames of the clip, and doubts.

Imported late, where it is needed: matplotlib may not be installed.
"""

from os import PathLike
from textwrap import wrap
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure

from mapctl import kinematics, retarget, rotations
from mapctl.formats.atomic import atomic_path
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.doubts import Fit

_SIZE, _DPI = (16.0, 9.6), 100  # inches
_LEFT, _RIGHT, _MIDDLE, _UNMATCHED, _DOUBT = "#4c78a8", "#f58518", "#333333", "#b5b5b5", "#d62728"
_MAX_LINES, _MAX_LINE = 5, 112  # reasons under the picture, and characters of a line of them
_MAX_NAME = 24  # characters of a joint's name

JointPositions = Float[np.ndarray, "joints 3"]
"""Positions of the rig's own joints, metres: Y up, facing +Z, the hips over the origin."""


def plot_rig(rigmap: RigMap, motion: Motion, fit: Fit, *, title: str, path: str | PathLike[str]) -> None:
    """Write a PNG, 1600 pixels wide, of a rig and a clip of it."""
    standing = retarget.from_canonical(Motion.at_rest(rigmap.skeleton), rigmap)
    tpose = _stand_upright(standing, rigmap, heading=0.0)
    first, middle = (_place_frame(rigmap, motion, number) for number in (0, motion.num_frames // 2))
    figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor="white")
    grid = figure.add_gridspec(1, 4, width_ratios=(5, 1, 1, 1), left=0.01, right=0.99, top=0.9, bottom=0.16)
    views = (("T-pose", tpose, 0), ("from its right", tpose, 2), ("first frame", first, 0), ("middle frame", middle, 0))
    for column, (name, positions, across) in enumerate(views):
        axes = figure.add_subplot(grid[column])
        axes.set_title(name, fontsize=9.5, color="#555555")
        _draw_body(axes, rigmap, fit, positions[:, [across, 1]], share=0.55 if column else 1.0)
        if column == 0:
            _draw_labels(axes, rigmap, fit, positions)
    _write(figure, rigmap, fit, title)
    with atomic_path(path) as scratch:
        figure.savefig(scratch, format="png", dpi=_DPI)


def _place_frame(rigmap: RigMap, motion: Motion, number: int) -> JointPositions:
    """Return the rig's joints in a frame of the clip."""
    picked = motion.slice(number, number + 1)
    canonical = retarget.to_canonical(picked, retarget.as_rig(rigmap))[0]
    return _stand_upright(picked, rigmap, heading=float(kinematics.heading(canonical.local_quat_xyzw[0, 0])))


def _stand_upright(motion: Motion, rigmap: RigMap, *, heading: float) -> JointPositions:
    positions = motion.joint_positions()[0]
    upright = rigmap.upright_quat_xyzw
    if upright is not None:
        positions = rotations.rotate(upright.expand(len(positions), 4), positions)
    positions = positions - positions[rigmap.joints["hips"]] * positions.new_tensor([1.0, 0.0, 1.0])
    return rotations.rotate_about_y(positions, torch.full((len(positions),), -heading, dtype=positions.dtype)).numpy()


def _colour_of(name: str) -> str:
    return _LEFT if name.startswith("left") else _RIGHT if name.startswith("right") else _MIDDLE


def _colour_joints(rigmap: RigMap) -> dict[int, str]:
    """Return the colour of each joint of the rig that is a canonical one, or that lies between two of them."""
    found, parents, matched = {}, rigmap.rig_skeleton.parents, set(rigmap.joints.values())
    for name, joint in rigmap.joints.items():
        chain = [joint]
        while parents[chain[-1]] >= 0 and parents[chain[-1]] not in matched and name != "hips":
            chain.append(parents[chain[-1]])
        found |= dict.fromkeys(chain if parents[chain[-1]] in matched else chain[:1], _colour_of(name))
    return found


def _draw_body(axes: Any, rigmap: RigMap, fit: Fit, flat: Float[np.ndarray, "joints 2"], *, share: float) -> None:
    """Draw bones and joints that hang from a canonical joint; `share` of the usual thickness."""
    parents, colours, joints = rigmap.rig_skeleton.parents, _colour_joints(rigmap), rigmap.joints
    shown: list[int] = []
    for joint, parent in enumerate(parents):
        if joint in joints.values() or parent in shown:
            shown.append(joint)
        if joint in shown and parent in shown:
            matched = joint in colours and joint != joints["hips"]
            width, colour = (4.0, colours[joint]) if matched else (1.3, _UNMATCHED)
            line = flat[[parent, joint]].T
            axes.plot(*line, color=colour, linewidth=width * share, solid_capstyle="round", zorder=2 if matched else 1)
    others = [joint for joint in shown if joint not in joints.values()]
    axes.scatter(*flat[others].T, s=9 * share, color=_UNMATCHED, zorder=3)
    for name, joint in joints.items():
        edge, width = (_DOUBT, 2.2) if name in fit.joints else ("white", 1.0)
        own = {"s": 70 * share**2, "edgecolors": edge, "linewidths": width * share, "zorder": 4}
        axes.scatter(*flat[joint], color=colours[joint], **own)
    axes.axhline(flat[shown, 1].min(), color="#888888", linewidth=1.0, zorder=0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_axis_off()


def _draw_labels(axes: Any, rigmap: RigMap, fit: Fit, positions: JointPositions) -> None:
    """Write both names of each joint, highest first, at the edges: those of left limbs and the trunk right, as seen."""
    names = rigmap.rig_skeleton.names
    for on_right in (False, True):
        own = [
            (n, j)
            for n, j in rigmap.joints.items()
            if on_right == (n.startswith("left") or n in ("hips", "spine", "chest"))
        ]
        own.sort(key=lambda pair: (-round(float(positions[pair[1], 1]), 2), abs(float(positions[pair[1], 0]))))
        for (name, joint), height in zip(own, np.linspace(0.96, 0.06, len(own)), strict=True):
            numbers = [str(number) for number, doubt in enumerate(fit.doubts, 1) if name in doubt.joints]
            title, short = f"{name} [{', '.join(numbers)}]" if numbers else name, names[joint]
            short = short if len(short) <= _MAX_NAME else f"{short[: _MAX_NAME // 2]}...{short[3 - _MAX_NAME // 2 :]}"
            line = {"arrowstyle": "-", "color": _colour_of(name), "linewidth": 0.7, "alpha": 0.6}
            axes.annotate(
                f"{title}\n{short}",
                xy=(positions[joint, 0], positions[joint, 1]),
                xytext=(0.995 if on_right else 0.005, height),
                textcoords="axes fraction",
                ha="right" if on_right else "left",
                va="center",
                fontsize=9,
                color=_DOUBT if numbers else _colour_of(name),
                arrowprops=line,
            )


def _write(figure: Any, rigmap: RigMap, fit: Fit, title: str) -> None:
    """Write the title and what was found above, and verdict and reasons below."""
    figure.text(0.012, 0.968, title, fontsize=14, weight="bold", va="center")
    found = f"rig {rigmap.rig.name}, score {rigmap.match.score:.2f}, rest pose {rigmap.rest}, up {rigmap.up}"
    found += f", facing {rigmap.facing}, T-pose from {rigmap.tpose_from}"
    figure.text(0.988, 0.968, found, fontsize=11, va="center", ha="right", color="#555555")
    ink = _DOUBT if fit.doubts else "#2ca02c"
    figure.text(0.012, 0.128, f"fit: {fit.verdict}", fontsize=12, weight="bold", color=ink, va="center")
    reasons = [f"[{number}] {doubt.reason}" for number, doubt in enumerate(fit.doubts, 1)]
    lines = [line for reason in reasons for line in wrap(reason, _MAX_LINE, subsequent_indent="     ")]
    lines = lines if len(lines) <= _MAX_LINES else [*lines[: _MAX_LINES - 1], "and more: see mapctl info"]
    for number, line in enumerate(lines):
        figure.text(0.115, 0.128 - 0.025 * number, line, fontsize=10, color=ink, va="center")
    for word, colour, x in (("left", _LEFT, 0.85), ("right", _RIGHT, 0.89), ("middle", _MIDDLE, 0.94)):
        figure.text(x, 0.128, word, fontsize=10, color=colour, weight="bold", va="center")
