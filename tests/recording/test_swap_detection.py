"""Limbs whose left and right are exchanged for some frames are exchanged back; motion as it was performed stays."""

from dataclasses import replace

import pytest
import torch
from captures import DEGREE, on_rig, trembling
from helpers import walk
from rig_maker import Make, make, names_of

from mapctl import retarget
from mapctl.recording.inspection import exchange_swapped_limbs

LEG, ARM = ("UpperLeg", "LowerLeg", "Foot", "Toes"), ("Shoulder", "UpperArm", "LowerArm", "Hand")
AXES = make(Make(names_of("mixamo"), bones_along_x=True))  # left and right arms have other axes
RIGS = {
    "canonical": lambda motion: motion,
    "bandai": lambda motion: retarget.from_canonical(motion, retarget.identify_rig(on_rig("bandai", 8).skeleton)),
    "other axes": AXES.motion,
}
SWAPS = {
    "leg": (LEG, [(40, 42)]),
    "legs for a frame, twice": (LEG, [(20, 21), (90, 91)]),
    "arm": (ARM, [(63, 67)]),
    "arm without shoulder": (ARM[1:], [(72, 75)]),
    "both": (LEG + ARM, [(30, 34)]),
}


def swapped(motion, parts, frames):
    left, right = joints_of(retarget.to_canonical(motion)[1], parts)
    columns = list(range(motion.num_joints))
    for one, other in zip(left, right, strict=True):
        columns[one], columns[other] = other, one
    quats = motion.local_quat_xyzw.clone()
    for start, stop in frames:
        quats[start:stop] = quats[start:stop, columns]
    return replace(motion, local_quat_xyzw=quats)


def joints_of(rigmap, parts):
    return [
        [rigmap.joints[side + part] for part in parts if side + part in rigmap.joints] for side in ("left", "right")
    ]


def largest_distance(first, second):
    return float((first.joint_positions() - second.joint_positions()).norm(dim=-1).max())


def exchanged_back(motion):
    hidden = torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool)
    return exchange_swapped_limbs(motion, retarget.to_canonical(motion)[1], hidden)


@pytest.mark.parametrize("raw", [False, True], ids=["from the T-pose", "in the file"])
@pytest.mark.parametrize("swap", SWAPS)
@pytest.mark.parametrize("rig", RIGS)
def test_swapped_limbs_are_found_and_exchanged_back(rig, swap, raw):
    parts, frames = SWAPS[swap]
    walked = trembling(walk(120, turn_rate=0.3), 3 * DEGREE)
    truth = RIGS[rig](walked)
    given = swapped(truth, parts, frames) if raw else RIGS[rig](swapped(walked, parts, frames))
    if largest_distance(given, truth) < 0.13:
        return  # raw rotations of this rig's arms are alike on both sides: nothing to see
    found, faults = exchanged_back(given)
    assert {(fault.start, fault.stop) for fault in faults} == set(frames)
    assert {fault.kind for fault in faults} == {"swap"}
    # Shoulders that differ by less than the noise may be exchanged or not.
    noise = largest_distance(truth, RIGS[rig](walk(120, turn_rate=0.3)))
    assert largest_distance(found, truth) < max(0.01, noise)
    assert exchanged_back(truth) == (truth, [])
