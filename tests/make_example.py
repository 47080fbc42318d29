"""Makes the motion that mapctl brings along, `example:noisy-walk`: python tests/make_example.py FILE.bvh

A synthetic performer walks an S on the free weights, and noise of a known size is added (`corruptions.py`). Nothing of
it comes from a capture or from the full weights, so that it is free for any use. Seeds are fixed; on another processor
rounding may differ, and so the walk by a little.
"""

import sys
import tempfile
from fractions import Fraction
from pathlib import Path

import torch
from corruptions import add_noise

import mapctl
from mapctl import cli
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

CURVE, SECONDS, SEED = "s:7", 8, 2
DEGREES, CENTIMETRES, SPIKES = 5.0, 2.0, 0.01
_HIPS_HEIGHT = 96.0
_BODY = {
    "Hips": ("", 0, 0, 0),
    "Spine": ("Hips", 0, 9, 0),
    "Spine1": ("Spine", 0, 12, 0),
    "Spine2": ("Spine1", 0, 12, 0),
    "Neck": ("Spine2", 0, 18, 0),
    "Head": ("Neck", 0, 10, 2),
}
_SIDE = {
    "Shoulder": ("Spine2", 4, 12, 0),
    "Arm": ("Shoulder", 14, 0, 0),
    "ForeArm": ("Arm", 28, 0, 0),
    "Hand": ("ForeArm", 26, 0, 0),
    "UpLeg": ("Hips", 10, -4, 0),
    "Leg": ("UpLeg", 0, -42, 0),
    "Foot": ("Leg", 0, -41, 0),
    "ToeBase": ("Foot", 0, -7, 14),
}
_ENDS = {"Head": (0.0, 0.18, 0.0), "Hand": (0.17, 0.0, 0.0), "ToeBase": (0.0, 0.0, 0.07)}
"""Centimetres from the joint above, left side; its mirror image is the right one. Metres of what ends there."""


def performer() -> Motion:
    """A second of standing in the T-pose, on bones of round lengths."""
    joints = {name: (above, (x, y, z)) for name, (above, x, y, z) in _BODY.items()}
    ends = {"Head": _ENDS["Head"]}
    for side, sign in (("Left", 1), ("Right", -1)):
        for name, (above, x, y, z) in _SIDE.items():
            joints[side + name] = (above if above in _BODY else side + above, (sign * x, y, z))
        for name in ("Hand", "ToeBase"):
            ends[side + name] = (sign * _ENDS[name][0], *_ENDS[name][1:])
    names = tuple(joints)
    parents = tuple(names.index(above) if above else -1 for above, _ in joints.values())
    offsets = torch.tensor([offset for _, offset in joints.values()], dtype=torch.float64) / 100
    root = torch.tensor([0.0, _HIPS_HEIGHT / 100, 0.0], dtype=torch.float64).repeat(30, 1)
    still = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).repeat(30, len(names), 1)
    return Motion(Skeleton(names, parents, offsets, ends), Fraction(30), root, still)


def make_walk(folder: Path) -> Motion:
    """The clean walk, by the command line as anybody would."""
    performer().save(folder / "performer.bvh")
    words = ["follow", CURVE, "--seconds", str(SECONDS), "--seed", str(SEED), "--weights", "free", "--quiet"]
    status = cli.main([*words, "--rig", str(folder / "performer.bvh"), "-o", str(folder / "walk.bvh")])
    if status:
        raise SystemExit(status)
    return mapctl.load(folder / "walk.bvh")


def spoil(walk: Motion) -> Motion:
    """The walk with noise."""
    generator = torch.Generator().manual_seed(SEED)
    return add_noise(walk, generator, degrees=DEGREES, centimetres=CENTIMETRES, spikes=SPIKES)


def main(out: Path) -> None:
    """Make it."""
    with tempfile.TemporaryDirectory() as folder:
        spoil(make_walk(Path(folder))).save(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
