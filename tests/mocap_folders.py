"""Small folders with the rigs, file names, rates and tables of sets that users bring. The motion is ours."""

from dataclasses import replace
from pathlib import Path

import torch
from helpers import walk
from rig_maker import Generated, Make, make, names_of

from mapctl.motion import Motion

STYLE_RIG = Make(names_of("xsens"), between={"chest": ("Chest2", "Chest3")}, extras=False)
"""100STYLE (Mason et al. 2022): 23 joints under the names of Xsens' BVH export, a T-pose with all rotations zero."""
STYLE_HEAD = (
    "STYLE_NAME,BR_START,BR_STOP,BW_START,BW_STOP,FR_START,FR_STOP,FW_START,FW_STOP,ID_START,ID_STOP,SR_START,SR_STOP,"
    "SW_START,SW_STOP,TR1_START,TR1_STOP,TR2_START,TR2_STOP,TR3_START,TR3_STOP"
)
KINDS = [word.removesuffix("_START") for word in STYLE_HEAD.split(",") if word.endswith("_START")]


def with_tposes(result: Generated, motion: Motion, before: int, after: int) -> Motion:
    """The motion on this rig between so many frames of a T-pose in its first and its last place."""
    still = torch.zeros(before + after, motion.skeleton.num_joints, 4, dtype=torch.float64)
    still[..., 3] = 1
    root = torch.cat([motion.root_position[:1].expand(before, 3), motion.root_position[-1:].expand(after, 3)])
    root = root.clone()
    root[:, 1] = motion.root_position[:, 1].max()
    quats = torch.cat([still[:before], motion.local_quat_xyzw, still[before:]])
    positions = torch.cat([root[:before], motion.root_position, root[before:]])
    return result.motion(replace(motion, root_position=positions, local_quat_xyzw=quats))


def write_styles(folder: Path, styles: dict[str, dict[str, tuple[int, int, int]]], *, fps: int = 60) -> Path:
    """Styles with their clips, each of so many frames of a T-pose before, of a walk, and of a T-pose after; and the
    table that says so."""
    result, lines = make(STYLE_RIG), [STYLE_HEAD]
    for number, (style, clips) in enumerate(styles.items()):
        (folder / style).mkdir(parents=True)
        cells = [style]
        for kind in KINDS:
            if kind not in clips:
                cells += ["N/A", "N/A"] if number % 2 else ["", ""]
                continue
            before, frames, after = clips[kind]
            motion = walk(frames, turn_rate=0.2 * number, seed=number, fps=fps)
            with_tposes(result, motion, before, after).save(folder / style / f"{style}_{kind}.bvh")
            cells += [str(before), str(before + frames)]
        lines.append(",".join(cells))
    (folder / "Frame_Cuts.csv").write_text("\r\n".join(lines) + "\r\n")
    return folder
