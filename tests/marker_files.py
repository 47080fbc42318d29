"""Small files of positions: the markers of a motion of the canonical body."""

import numpy as np
import torch

from mapctl import rotations
from mapctl.skeleton import CANONICAL

# Plug-in Gait markers on the canonical body: joint in whose frame they are, and where, metres; of the left side.
MARKERS = {
    "LASI": ("hips", (0.087, 0.0331, 0.0515)),  # from which the regression leads to the hips of this body
    "LPSI": ("hips", (0.04, 0.0557, -0.0766)),
    "LTHI": ("leftUpperLeg", (0.08, -0.2, 0.03)),
    "LKNE": ("leftUpperLeg", (0.055, -0.39, 0.0)),
    "LTIB": ("leftLowerLeg", (0.06, -0.2, 0.02)),
    "LANK": ("leftLowerLeg", (0.04, -0.41, 0.0)),
    "LHEE": ("leftFoot", (0.0, -0.075, -0.065)),
    "LTOE": ("leftFoot", (0.0, -0.055, 0.09)),
    "LSHO": ("leftShoulder", (0.055, 0.05, 0.0)),
    "LELB": ("leftUpperArm", (0.243, 0.04, 0.0)),
    "LWRA": ("leftLowerArm", (0.223, 0.0, 0.03)),
    "LWRB": ("leftLowerArm", (0.223, 0.0, -0.03)),
    "LFIN": ("leftHand", (0.08, 0.02, 0.0)),
    "LFHD": ("head", (0.07, 0.1, 0.09)),
    "LBHD": ("head", (0.07, 0.1, -0.08)),
}
MIDDLE = {
    "C7": ("chest", (0.0, 0.17, -0.06)),
    "T10": ("chest", (0.0, -0.03, -0.1)),
    "CLAV": ("chest", (0.0, 0.11, 0.06)),
    "STRN": ("chest", (0.0, 0.0, 0.1)),
}
Z_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # of row vectors, to Z up


def mark(motion, *, leave=()):
    """Return labels and positions (frames, markers, 3) of markers, metres, Y up."""
    world, joints = motion.joint_rotations(), motion.joint_positions()
    found = {}
    for label, (joint, at) in {**MARKERS, **MIDDLE}.items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            name = ("R" + label[1:], joint.replace("left", "right")) if side == "right" else (label, joint)
            if label in MIDDLE and side == "right":
                continue
            own = CANONICAL.index(name[1])
            offset = torch.tensor([sign * at[0], *at[1:]], dtype=torch.float64)
            found[name[0]] = joints[:, own] + rotations.rotate(world[:, own], offset)
    labels = [label for label in found if label not in leave]
    return labels, torch.stack([found[label] for label in labels], dim=1).numpy()


def write_trc(path, labels, values, *, unit="mm", fps=60):
    """Write values in the file's unit; NaN as empty cells."""
    count = len(labels)
    lines = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"]
    lines += [f"{fps}\t{fps}\t{len(values)}\t{count}\t{unit}", "Frame#\tTime\t" + "\t\t\t".join(labels)]
    lines += ["\t\t" + "\t".join(f"{axis}{n + 1}" for n in range(count) for axis in "XYZ"), ""]
    for frame, row in enumerate(values.reshape(len(values), -1)):
        cells = ["" if np.isnan(value) else f"{value:.5f}" for value in row]
        lines.append("\t".join([str(frame + 1), f"{frame / fps:.4f}", *cells]))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_c3d(path, labels, values, *, unit="mm", fps=60):
    import ezc3d

    file = ezc3d.c3d()
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["RATE"]["value"] = [fps]
    points = np.ones((4, len(labels), len(values)))
    points[:3] = values.T
    file["data"]["points"] = points
    file.write(str(path))
    return path


def write_csv(path, labels, values, *, unit="", fps=60):
    names = [f"{label}.{axis}" for label in labels for axis in "xyz"]
    rows = [",".join(["time", *names])]
    for frame, row in enumerate(values.reshape(len(values), -1)):
        rows.append(",".join([f"{frame / fps:.5f}", *("" if np.isnan(value) else f"{value:.6f}" for value in row)]))
    path.write_text("\n".join(rows) + "\n")
    return path


def write_motive(path, labels, values, *, fps=60):
    """Write the export of Motive: a row of settings, then type, name, what the numbers are, and axes."""
    spread = [label for label in labels for _ in range(3)]
    rows = [["Format Version", "1.23", "Export Frame Rate", str(fps), "Length Units", "Meters"], []]
    rows += [["", "Type"] + ["Marker"] * len(spread), ["", "Name", *(f"Bob:{label}" for label in spread)]]
    rows += [
        ["", "ID", *spread],
        ["", ""] + ["Position"] * len(spread),
        ["Frame", "Time (Seconds)"] + list("XYZ") * len(labels),
    ]
    for frame, row in enumerate(values.reshape(len(values), -1)):
        rows.append([str(frame), f"{frame / fps:.5f}", *(f"{value:.6f}" for value in row)])
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return path


def order_joints(motion):
    """Positions of the 22 joints of HumanML3D, metres; the middle of the spine is the chest here."""
    like = "hips leftUpperLeg rightUpperLeg spine leftLowerLeg rightLowerLeg chest leftFoot rightFoot chest leftToes"
    like += " rightToes neck leftShoulder rightShoulder head leftUpperArm rightUpperArm leftLowerArm rightLowerArm"
    order = CANONICAL.indices(f"{like} leftHand rightHand".split())
    return motion.joint_positions()[:, order].numpy()


WRITERS = {".trc": (write_trc, 1000.0), ".c3d": (write_c3d, 1000.0), ".csv": (write_csv, 100.0)}
MARKED = (*WRITERS, ".npy")
"""Endings of files of positions."""


def write_markers(path, motion):
    """Write the markers of a motion by the ending of a path, or its joints."""
    if path.suffix == ".npy":
        np.save(path, order_joints(motion))
    else:
        writer, scale = WRITERS[path.suffix]
        labels, values = mark(motion)
        writer(path, labels, values * scale)
