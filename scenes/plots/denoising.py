"""Pictures of denoising: angles and feet before and after (Wang et al. 2019, figures 10 and 11), and side by side."""

from collections.abc import Callable
from dataclasses import replace
from os import PathLike

import numpy as np
import torch

from mapctl import retarget, rotations
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import TOES
from scenes.film import film
from scenes.plots import open_plots

_JOINTS = ("leftUpperArm", "rightLowerArm", "leftUpperLeg", "rightLowerLeg", "chest")
_BEFORE, _AFTER = "#bbbbbb", "#4c78a8"
_SIDE_OFFSET = 1.4  # metres between the two of a film


def plot(capture: Motion, clean: Motion, path: str | PathLike[str], *, rig: Rig | None = None) -> None:
    """Write a PNG: angles of some joints, and height and speed of the toes. RequestError without matplotlib."""
    before, after = (retarget.to_canonical(motion, rig)[0] for motion in (capture, clean))
    seconds, joints = np.arange(clean.num_frames) / float(clean.fps), len(_JOINTS)
    with open_plots(path, joints + 4, inches=(12, 2.1 * (joints + 4)), dpi=90) as rows:
        for motion, colour in ((before, _BEFORE), (after, _AFTER)):
            for row, name in zip(rows, _JOINTS, strict=False):
                row.plot(seconds, _compute_joint_angle(motion, name), color=colour, linewidth=1)
                row.set_ylabel(f"{name}\ndegrees")
            for side, name in enumerate(TOES):
                place = motion.joint_positions()[:, motion.skeleton.index(name)].numpy()
                speed = np.linalg.norm(np.diff(place[:, ::2], axis=0), axis=1) * float(motion.fps)
                upper, lower = rows[joints + 2 * side : joints + 2 * side + 2]
                upper.plot(seconds, 100 * place[:, 1], color=colour, linewidth=1)
                upper.set_ylabel(f"{name}\nheight, cm")
                lower.plot(seconds[1:], speed, color=colour, linewidth=1)
                lower.set(ylabel=f"{name}\nspeed, m/s", ylim=(0, 5))
        rows[0].legend(["before", "after"], loc="upper right", frameon=False)
        rows[-1].set_xlabel("seconds")


def film_side_by_side(
    capture: Motion,
    clean: Motion,
    path: str | PathLike[str],
    *,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Film the capture, grey, and the result beside it."""
    before, after = (retarget.to_canonical(motion, rig)[0] for motion in (capture, clean))
    aside = torch.tensor([_SIDE_OFFSET, 0.0, 0.0], dtype=torch.float64)
    film(
        [(after, None), (replace(before, root_position=before.root_position + aside), None, "#999999")],
        path,
        progress=progress,
    )


def _compute_joint_angle(motion: Motion, name: str) -> np.ndarray:
    """Compute the angle from the T-pose, degrees."""
    quats = motion.local_quat_xyzw[:, motion.skeleton.index(name)]
    return torch.rad2deg(rotations.to_rotation_vector(quats).norm(dim=-1)).numpy()
