"""How long the way from one pose to the next takes people: a regression over mocap, by which a timing is suggested.

The logarithm of the seconds is linear in what two poses show: how far apart they are in the world and limb by limb, how
the hips turn, and how long steps, bent knees and arms, and a leaning trunk are, which tell a stroll from a run.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.intent.keyframes import Keys
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, leg_length

TRAVELLING_DISTANCE = 0.3
"""Metres of the hips over the ground from which a pair of poses is on its way, and the distance tells the time."""
MAX_FITTED_DISTANCE = 4.0
"""Metres beyond which people go on as fast as they do over so many: mocap's pairs end about there."""
_GAIT_CUES = ("step", "stride", "lift", "hips", "toes", "knees", "arms", "lean")
FEATURES = (
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
WEIGHTS: tuple[float, ...] = (
    0.7268,
    0.5584,
    -0.1348,
    0.01211,
    0.132,
    0.05434,
    0.09474,
    0.145,
    -0.1124,
    0.672,
    -2.509,
    -2.11,
    -5.756,
    -1.427,
    5.594,
    0.9593,
    -0.1232,
    -0.4131,
    1.52,
    1.446,
    1.752,
    -3.662,
    -1.475,
    -0.2542,
    -1.575,
)
"""Of the features, for the logarithm of seconds: `controllers.benchmarks.keyframe_timing.fit_timing_weights` on 5,000
pairs of poses 0.25 to 4 s apart, of clips drawn from those that the bundled infiller was trained on."""
_MIN_SECONDS, _MAX_SECONDS = 0.25, 4.0  # seconds within which pairs lay
_RATIO_PERCENTILES = {
    "going": (0.74, 1.35),
    "staying": (0.35, 2.05),
}  # 10th and 90th percentiles of true over fitted seconds


@dataclass(frozen=True)
class KeyInterval:
    """Between two neighbouring keys that are whole poses."""

    start: int
    """Frame of the first."""
    stop: int
    """And of the second."""
    suggested: int
    """Frames from one to the other as mocap would have it."""
    usual: tuple[int, int]
    """Frames within which four of five of mocap's pairs would lie."""
    metres: float
    """From hips to hips over the ground, on this body."""
    given_speed: float
    """Over these, m/s, with the given timing."""
    suggested_speed: float
    """And with the suggested one."""
    pose_distance_cm: float
    """Mean distance of the joints seen from the hips."""

    @property
    def given(self) -> int:
        """Frames from one to the other."""
        return self.stop - self.start

    @property
    def reason(self) -> str:
        """Why, in numbers."""
        low, high = self.usual
        verdict = "short" if self.given < low else "long" if self.given > high else "usual"
        if self.metres < TRAVELLING_DISTANCE:
            return (
                f"{verdict}: about in place ({self.metres:.2f} m), joints {self.pose_distance_cm:.0f} cm apart; mocap "
                f"mostly takes {low} to {high} frames"
            )
        return (
            f"{verdict}: {self.metres:.2f} m at {self.given_speed:.2f} m/s, where poses like these go at "
            f"{self.suggested_speed:.2f} m/s; mocap mostly takes {low} to {high} frames"
        )

    def summary(self) -> dict[str, Any]:
        """For a report."""
        return {
            "from": self.start,
            "to": self.stop,
            "given": self.given,
            "suggested": self.suggested,
            "usual": list(self.usual),
            "metres": self.metres,
            "given_m_s": self.given_speed,
            "suggested_m_s": self.suggested_speed,
            "apart_cm": self.pose_distance_cm,
            "reason": self.reason,
        }


def suggest_intervals(motion: Motion, keys: Keys, rig: Rig | None = None) -> list[KeyInterval]:
    """For neighbouring keys that are whole poses how long the way between them would take; keys that tell less lie
    within. RequestError for keys that do not fit the motion.
    """
    wanted = [key.frame for key in keys.checked(motion) if key.what == "pose"]
    poses = _select_frames(motion, wanted)
    canonical = to_canonical(poses, rig)[0]
    scale, fps = leg_length(canonical.skeleton) / leg_length(CANONICAL), float(motion.fps)
    body = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    first = torch.arange(len(wanted) - 1)
    features, ways = compute_pair_features(body, first, first + 1), compute_travel_distance(body, first, first + 1)
    intervals = []
    for number, (start, stop) in enumerate(pairwise(wanted)):
        metres = ways[number]
        seconds = float(predict_seconds(features[number : number + 1], metres[None]))
        usual = _RATIO_PERCENTILES["going" if float(metres) >= TRAVELLING_DISTANCE else "staying"]
        suggested = max(1, round(seconds * fps))
        intervals.append(
            KeyInterval(
                start,
                stop,
                suggested,
                (max(1, round(usual[0] * seconds * fps)), round(usual[1] * seconds * fps)),
                float(metres) * scale,
                float(metres) * scale * fps / (stop - start),
                float(metres) * scale * fps / suggested,
                100 * scale * (math.exp(float(features[number, 2])) - _MIN_POSE_DISTANCE),
            )
        )
    return intervals


def predict_seconds(
    features: Float[Tensor, "pairs features"], metres: Float[Tensor, " pairs"]
) -> Float[Tensor, " pairs"]:
    """What the regression makes of pairs of poses so far apart."""
    seconds = torch.exp(features @ features.new_tensor(WEIGHTS)).clamp(_MIN_SECONDS, _MAX_SECONDS)
    return seconds * (metres / MAX_FITTED_DISTANCE).clamp_min(1)


def compute_pair_features(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, "pairs features"]:
    """Of pairs of frames of a motion on canonical bones, in the order of `FEATURES`: of metres, also their logarithms,
    and radians.
    """
    places, facing = body.joint_positions(), heading(body.local_quat_xyzw[:, 0])
    turn = rotations.about_y(-facing)[:, None].expand(-1, CANONICAL.num_joints, 4)
    own = rotations.rotate(turn, places - places[:, :1])
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


def compute_travel_distance(
    body: Motion, first: Int[Tensor, " pairs"], second: Int[Tensor, " pairs"]
) -> Float[Tensor, " pairs"]:
    """Of the hips over the ground, metres."""
    return (body.root_position[second] - body.root_position[first])[:, ::2].norm(dim=-1)


def _select_frames(motion: Motion, frames: Sequence[int]) -> Motion:
    """These frames alone."""
    picked = torch.tensor(frames)
    moving = {joint: values[picked] for joint, values in motion.moving_offsets.items()}
    return Motion(motion.skeleton, motion.fps, motion.root_position[picked], motion.local_quat_xyzw[picked], moving)
