"""Pairs of poses, and what two poses show of the way between them: how far they are apart in the world and limb by
limb, how the hips turn, and how long steps, bent knees and arms, and a leaning trunk are, which tell a stroll from a
run.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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
"""Metres of the hips over the ground from which a pair of poses is on its way, and the distance tells the time."""
MAX_FITTED_DISTANCE = 4.0
"""Metres beyond which people go on as fast as they do over so many: mocap's pairs end about there."""
_GAIT_CUES = ("step", "stride", "lift", "hips", "toes", "knees", "arms", "lean")
PAIR_FEATURES = (
    "one",
    "way",
    "apart",
    "worst",
    "turned",
    "way2",
    "way_apart",
    "aside",
    "ahead",
    *_GAIT_CUES,
    *(f"way_{name}" for name in _GAIT_CUES),
)
"""Of a pair of poses, as `compute_pair_features` gives them."""
_MIN_POSE_DISTANCE = 0.03  # metres below which it is all one how far two poses are apart
_JOINT_INDEX = {name: index for index, name in enumerate(CANONICAL.names)}


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Pairs of poses of mocap."""

    features: Float[Tensor, "pairs features"]
    """Of `PAIR_FEATURES`."""
    metres: Float[Tensor, " pairs"]
    """Between the hips over the ground."""
    seconds: Float[Tensor, " pairs"]
    """Between the poses."""


@runtime_checkable
class TimingModel(Protocol):
    """What knows how long the way between two poses takes (see `priors.load_keyframe_timing`)."""

    def estimate_seconds(
        self, features: Float[Tensor, "pairs features"], metres: Float[Tensor, " pairs"]
    ) -> Float[Tensor, "pairs 3"]:
        """Of pairs so far apart over the ground, seconds: what four of five of mocap's take at least, what is
        suggested, and what they take at most.
        """
        ...


def sample_pose_pairs(
    bodies: Iterable[Motion], generator: torch.Generator, *, count: int, shortest: float, longest: float
) -> PosePairs:
    """`count` pairs of every clip on canonical bones at the priors' rate that is long enough, their seconds evenly
    between the bounds and the clip's own length.
    """
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
    """Of pairs of frames of a motion on canonical bones, in the order of `PAIR_FEATURES`: metres, their logarithms, and
    radians.
    """
    places, facing = body.joint_positions(), heading(body.local_quat_xyzw[:, 0])
    own = _see_from_hips(places, facing)
    metres = compute_travel_distance(body, first, second)
    way = torch.log(metres.clamp(max=MAX_FITTED_DISTANCE) + 0.1)
    off = (own[second] - own[first]).norm(dim=-1)
    apart, worst = torch.log(off.mean(dim=-1) + _MIN_POSE_DISTANCE), torch.log(off.amax(dim=-1) + 0.05)
    turned = rotations.wrap_angle(facing[second] - facing[first]).abs()
    gone = rotations.rotate(rotations.about_y(-facing[first]), places[second, 0] - places[first, 0])
    gone = gone / (metres + 0.1)[:, None]
    cues = _compute_gait_cues(own, places)
    cues = (cues[first] + cues[second]) / 2
    plain = [torch.ones_like(way), way, apart, worst, turned, way.square(), way * apart, gone[:, 0].abs(), gone[:, 2]]
    return torch.cat([torch.stack(plain, dim=-1), cues, way[:, None] * cues], dim=-1)


def _compute_gait_cues(
    own: Float[Tensor, "frames joints 3"], places: Float[Tensor, "frames joints 3"]
) -> Float[Tensor, "frames cues"]:
    """What a pose shows of the gait, metres; joints seen from hips that face ahead, and in the world."""
    left, right = own[:, _JOINT_INDEX["leftToes"]], own[:, _JOINT_INDEX["rightToes"]]
    lowest = torch.minimum(left[:, 1], right[:, 1])
    ahead = (left - right).abs()
    legs, arms = (
        torch.stack(
            [
                (own[:, _JOINT_INDEX[side + upper]] - own[:, _JOINT_INDEX[side + end]]).norm(dim=-1)
                for side in ("left", "right")
            ]
        ).mean(dim=0)
        for upper, end in (("UpperLeg", "Foot"), ("UpperArm", "Hand"))
    )
    return torch.stack(
        [
            (left - right).norm(dim=-1),
            ahead[:, 2],
            ahead[:, 1],
            -lowest,
            places[:, 0, 1] + lowest,
            legs,
            arms,
            own[:, _JOINT_INDEX["head"], 2],
        ],
        dim=-1,
    )


def compute_pose_distance(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, " pairs"]:
    """Mean distance of the joints seen from hips that face ahead, metres."""
    own = _see_from_hips(body.joint_positions(), heading(body.local_quat_xyzw[:, 0]))
    return (own[second] - own[first]).norm(dim=-1).mean(dim=-1)


def compute_travel_distance(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, " pairs"]:
    """Of the hips over the ground, metres."""
    return (body.root_position[second] - body.root_position[first])[:, ::2].norm(dim=-1)


def _see_from_hips(
    places: Float[Tensor, "frames joints 3"], facing: Float[Tensor, " frames"]
) -> Float[Tensor, "frames joints 3"]:
    turn = rotations.about_y(-facing)[:, None].expand(-1, CANONICAL.num_joints, 4)
    return rotations.rotate(turn, places - places[:, :1])
