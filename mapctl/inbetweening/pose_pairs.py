"""Pairs of poses and their features for keyframe timing: distance in the world and by limb, rotation of the hips, and
cues of the gait (step length, bent knees and arms, a leaning trunk), which distinguish a stroll from a run."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

TRAVELLING_DISTANCE = 0.3
"""Distance of the hips over the ground, metres, from which a pair of poses is travelling, and distance determines time.
"""
MAX_FITTED_DISTANCE = 4.0
"""Distance, metres, beyond which speed is taken as constant: mocap's pairs end about there."""
_GAIT_CUES = ("step", "stride", "lift", "hips", "toes", "knees", "arms", "lean")
PAIR_FEATURES = (
    "one",
    "distance",
    "apart",
    "worst",
    "turned",
    "distance2",
    "distance_apart",
    "aside",
    "ahead",
    *_GAIT_CUES,
    *(f"distance_{name}" for name in _GAIT_CUES),
)
"""Names of a pair's features, in the order of `compute_pair_features`."""
_MIN_POSE_DISTANCE = 0.03  # metres, added to the distance of two poses so that tiny ones do not matter
_JOINT_INDEX = {name: index for index, name in enumerate(CANONICAL.names)}


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Pairs of poses of mocap."""

    features: Float[Tensor, "pairs features"]
    """Features in the order of `PAIR_FEATURES`."""
    metres: Float[Tensor, " pairs"]
    """Distance of the hips over the ground, metres."""
    seconds: Float[Tensor, " pairs"]
    """Time between the poses, seconds."""


def sample_pose_pairs(
    bodies: Iterable[Motion], generator: torch.Generator, *, count: int, shortest: float, longest: float
) -> PosePairs:
    """Sample `count` pairs from every clip on canonical bones at the priors' rate that is long enough, their seconds
    uniformly between the bounds and the clip's own length."""
    features, metres, seconds = [], [], []
    low = round(shortest * PRIOR_FPS)
    for body in bodies:
        high = min(round(longest * PRIOR_FPS), body.num_frames - 1)
        if high <= low:
            continue
        frames = torch.randint(low, high + 1, (count,), generator=generator)
        first = (torch.rand(count, generator=generator) * (body.num_frames - frames)).long()
        features.append(compute_pair_features(body, first, first + frames))
        metres.append(compute_travel_distance(body, first, first + frames))
        seconds.append(frames.double() / PRIOR_FPS)
    if not features:
        raise RequestError(f"no clip is longer than {shortest:g} s, which poses are to be apart")
    return PosePairs(torch.cat(features), torch.cat(metres), torch.cat(seconds))


def compute_pair_features(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, "pairs features"]:
    """Compute the features of pairs of frames of a motion on canonical bones, in the order of `PAIR_FEATURES`: metres,
    their logarithms, and radians."""
    positions, facing = body.joint_positions(), heading(body.local_quat_xyzw[:, 0])
    own = _see_from_hips(positions, facing)
    metres = compute_travel_distance(body, first, second)
    distance = torch.log(metres.clamp(max=MAX_FITTED_DISTANCE) + 0.1)
    joint_distances = (own[second] - own[first]).norm(dim=-1)
    pose = torch.log(joint_distances.mean(dim=-1) + _MIN_POSE_DISTANCE)
    worst = torch.log(joint_distances.amax(dim=-1) + 0.05)
    turned = rotations.wrap_angle(facing[second] - facing[first]).abs()
    displacement = rotations.rotate(rotations.about_y(-facing[first]), positions[second, 0] - positions[first, 0])
    displacement = displacement / (metres + 0.1)[:, None]
    cues = _compute_gait_cues(own, positions)
    cues = (cues[first] + cues[second]) / 2
    plain = [torch.ones_like(distance), distance, pose, worst, turned, distance.square(), distance * pose]
    plain += [displacement[:, 0].abs(), displacement[:, 2]]
    return torch.cat([torch.stack(plain, dim=-1), cues, distance[:, None] * cues], dim=-1)


def _compute_gait_cues(
    own: Float[Tensor, "frames joints 3"], positions: Float[Tensor, "frames joints 3"]
) -> Float[Tensor, "frames cues"]:
    """Compute a pose's cues of the gait, metres, from joints in the world and relative to hips and facing."""
    left, right = own[:, _JOINT_INDEX["leftToes"]], own[:, _JOINT_INDEX["rightToes"]]
    lowest = torch.minimum(left[:, 1], right[:, 1])
    ahead = (left - right).abs()

    def length(upper: str, end: str) -> Tensor:
        sides = [own[:, _JOINT_INDEX[side + upper]] - own[:, _JOINT_INDEX[side + end]] for side in ("left", "right")]
        return torch.stack([side.norm(dim=-1) for side in sides]).mean(dim=0)

    step, hips = (left - right).norm(dim=-1), positions[:, 0, 1] + lowest
    limbs, lean = (length("UpperLeg", "Foot"), length("UpperArm", "Hand")), own[:, _JOINT_INDEX["head"], 2]
    return torch.stack([step, ahead[:, 2], ahead[:, 1], -lowest, hips, *limbs, lean], dim=-1)


def compute_pose_distance(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, " pairs"]:
    """Compute the mean distance of the joints relative to the hips and their facing, metres."""
    own = _see_from_hips(body.joint_positions(), heading(body.local_quat_xyzw[:, 0]))
    return (own[second] - own[first]).norm(dim=-1).mean(dim=-1)


def compute_travel_distance(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, " pairs"]:
    """Compute the distance of the hips over the ground, metres."""
    return (body.root_position[second] - body.root_position[first])[:, ::2].norm(dim=-1)


def _see_from_hips(
    positions: Float[Tensor, "frames joints 3"], facing: Float[Tensor, " frames"]
) -> Float[Tensor, "frames joints 3"]:
    turn = rotations.about_y(-facing)[:, None].expand(-1, CANONICAL.num_joints, 4)
    return rotations.rotate(turn, positions - positions[:, :1])
