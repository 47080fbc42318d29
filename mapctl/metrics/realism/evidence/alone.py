"""What one group of inputs tells alone: accuracy of networks that are given nothing else."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.metrics.realism.classifier import ClassifierSettings, average_verdicts, judge_folds
from mapctl.metrics.realism.evidence.parts import BANDS, JOINTS, cut_parts, join_bone, join_parts
from mapctl.metrics.realism.evidence.paths import INPUTS
from mapctl.metrics.realism.windows import HIPS, WindowSettings

_FEET = "leftFoot", "leftToes", "rightFoot", "rightToes"


class Region(NamedTuple):
    """Joints that are judged together."""

    joints: tuple[str, ...]
    """Their names."""
    from_hips: bool = True
    """Whether their places are those from the hips in each frame, or over the ground."""


REGIONS: Mapping[str, Region] = {
    "feet over the ground": Region(_FEET, from_hips=False),
    "legs": Region(("leftUpperLeg", "leftLowerLeg", "rightUpperLeg", "rightLowerLeg", *_FEET)),
    "trunk and head": Region(("spine", "chest", "neck", "head")),
    "arms": Region(
        tuple(side + part for side in ("left", "right") for part in ("Shoulder", "UpperArm", "LowerArm", "Hand"))
    ),
}
"""Regions of the body that are measured alone."""
GROUPS = (*BANDS, *JOINTS, *INPUTS, *REGIONS)
"""Groups that are measured alone."""


def measure_alone(
    made: Sequence[Float[Tensor, "_ joints 3"]],
    mocap: Sequence[Float[Tensor, "_ joints 3"]],
    *,
    windows: WindowSettings,
    classifier: ClassifierSettings,
    seed: int,
    groups: Collection[str] = GROUPS,
    paired: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Measure the balanced held-out accuracy by each of some of GROUPS alone, on the same folds for all.

    A joint is its place and velocity from the joint above it, a band the whole body's motion in it. What a group tells
    alone and what is lost without it are different questions where groups know the same: so both are asked. An exchange
    of the hips, which carry everything, says little of the hips: REGIONS tell them from the feet and the rest.
    `made` and `mocap` are `canonical_positions` of each clip, `paired` as `judge_folds` has it.
    """
    parts = [[cut_parts(clip, windows) for clip in clips] for clips in (made, mocap)]
    bones = [[clip.sum(dim=1) for clip in clips] for clips in parts]
    found = {}
    for name in (each for each in GROUPS if each in groups):
        pick, source = (_pick_band, parts) if name in BANDS else (_pick_joints, bones)
        sets = ([pick(name, clip) for clip in clips] for clips in source)
        generator = torch.Generator().manual_seed(seed)
        found[name] = average_verdicts(
            [*judge_folds(*sets, generator=generator, settings=classifier, paired=paired)]
        ).accuracy
        tick()
    return found


def _pick_band(
    name: str, parts: Float[Tensor, "_ bands frames_and_one joints 3"]
) -> Float[Tensor, "_ frames channels"]:
    """Return the channels of one of BANDS of a clip."""
    return join_parts(parts[:, BANDS.index(name)])


def _pick_joints(name: str, bones: Float[Tensor, "_ frames_and_one joints 3"]) -> Float[Tensor, "_ frames channels"]:
    """Return the channels of one of the other GROUPS, in which all bands are summed."""
    if name in JOINTS:
        return join_bone(bones[:, :, JOINTS.index(name)])
    if name in INPUTS:
        return join_parts(bones).unflatten(-1, (len(INPUTS), -1))[:, :, INPUTS.index(name)]
    return _join_region(bones, REGIONS[name])


def _join_region(
    bones: Float[Tensor, "_ frames_and_one joints 3"], region: Region
) -> Float[Tensor, "_ frames channels"]:
    """Return the channels of a region: places (m), then velocities."""
    if region.from_hips:
        bones = bones.clone()
        bones[:, :, HIPS] = 0
    kept = [JOINTS.index(joint) for joint in region.joints]
    return join_parts(bones).unflatten(-1, (2, len(JOINTS), 3))[..., kept, :].flatten(-3)
