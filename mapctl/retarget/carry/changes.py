"""What retargeting changed, in numbers and as sentences for the user."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.joint_names import abbreviate_names
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.carry.hands import HandTargets
from mapctl.retarget.stance import FEET
from mapctl.retarget.topology import ancestors
from mapctl.skeleton import leg_length

_FOOT_METRES = 0.005  # metres that a foot misses its target by before it is worth a line
_HAND_METRES = 0.01  # metres that a hand does
_DIP_METRES = 0.05  # metres that hips go lower than in scale before it is worth a line
_MOVES_RADIANS = math.radians(1.0)  # angle within which a joint does not move


@dataclass(frozen=True)
class Miss:
    """How far effectors are from where they should be."""

    metres: float = 0.0
    """The farthest, metres."""
    frame: int = 0
    """Frame in which that is."""
    frames: int = 0
    """Frames in which one is farther off than is worth a line: 0.5 cm for feet, 1 cm for hands."""
    of_frames: int = 0
    """Frames of the motion."""


@dataclass(frozen=True)
class Changes:
    """What retargeting changed, beside bones."""

    scale: float = 1.0
    """Length of the body's legs over the giver's."""
    travel_ratio: float = 1.0
    """Way of the hips over the ground over the giver's; 1 for who stays in place."""
    hips_lowered_m: float = 0.0
    """How much lower the hips are at most than in scale, metres, for legs that are too short."""
    hands_moved_m: float = 0.0
    """How far hands are moved at most to where they touch what the giver's touch, metres."""
    feet_missed: Miss = Miss()
    """Ankles against their targets."""
    hands_missed: Miss = Miss()
    """Hands that are near something against their targets."""
    foot_tilt_deg: float = 0.0
    """By how much the giver's T-pose lays its feet wrongly at most, degrees, positive down; it is taken out."""
    unmatched_joints: tuple[str, ...] = ()
    """Joints of the giver that move and have no counterpart."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return sentences about what could not be kept; empty where all is."""
        feet, hands, dip, names = self.feet_missed, self.hands_missed, self.hips_lowered_m, self.unmatched_joints
        found = (
            (feet.frames, _note_miss("the legs are too short for some of the way: feet are", feet, _FOOT_METRES)),
            (hands.frames, _note_miss("the arms are too short for some of it: hands are", hands, _HAND_METRES)),
            (dip >= _DIP_METRES, f"the hips are up to {100 * dip:.1f} cm lower than in scale, so that the feet reach"),
            (names, f"joints without a counterpart are left out: {abbreviate_names(names)}"),
        )
        return tuple(note for counts, note in found if counts)


@dataclass(frozen=True, eq=False)
class RetargetedMotion:
    """A motion on another body."""

    motion: Motion
    """On canonical joints, with the bones of the body."""
    changes: Changes = Changes()
    """What was changed."""
    fingers: Mapping[int, Float[Tensor, "frames 4"]] = field(default_factory=dict)
    """Local rotations (xyzw) of the body's finger joints that turn as the giver's, by joint of its rig."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return sentences about what could not be kept; empty where all is."""
        return self.changes.notes


def measure_changes(
    given: Motion,
    done: Motion,
    ankles: Float[Tensor, "frames 2 3"],
    hands: HandTargets,
    *,
    dip: Float[Tensor, "frames 3"],
    tilt: Float[Tensor, "2 2"],
) -> Changes:
    """Measure what became of a motion (canonical joints): `ankles` and `hands` are what was aimed at, `dip` how much
    lower the hips are than in scale, metres, `tilt` the pitch of foot and toes taken out of each foot, radians."""
    ways = [float(m.root_position[:, ::2].diff(dim=0).norm(dim=-1).sum()) for m in (done, given)]
    return Changes(
        scale=leg_length(done.skeleton) / leg_length(given.skeleton),
        travel_ratio=ways[0] / ways[1] if ways[1] > 1e-6 else 1.0,
        hips_lowered_m=max(0.0, float(dip[:, 1].max())),
        hands_moved_m=float(hands.offset.norm(dim=-1).max()),
        feet_missed=_measure_miss((done.joint_positions()[:, FEET] - ankles).norm(dim=-1), _FOOT_METRES),
        hands_missed=_measure_miss(hands.errors, _HAND_METRES),
        foot_tilt_deg=-math.degrees(float(tilt[:, 0].flatten()[tilt[:, 0].abs().argmax()])),
    )


def list_unmatched_joints(clip: Motion, giver: RigMap, matched: Collection[int]) -> tuple[str, ...]:
    """List the joints of a clip that move and are not `matched`, nor is or hangs from them any canonical joint: what
    their turns do is lost."""
    led_by = ancestors(clip.skeleton, [*giver.joints.values(), *matched])
    dots = (clip.local_quat_xyzw * clip.local_quat_xyzw[:1]).sum(-1).abs().amin(dim=0).clamp(max=1.0)
    moves = 2 * torch.acos(dots) > _MOVES_RADIANS
    return tuple(name for j, name in enumerate(clip.skeleton.names) if j not in led_by and bool(moves[j]))


def _measure_miss(off: Float[Tensor, "frames 2"], noted: float) -> Miss:
    farthest = off.amax(dim=-1)
    return Miss(float(farthest.max()), int(farthest.argmax()), int((farthest > noted).sum()), len(off))


def _note_miss(begin: str, miss: Miss, noted: float) -> str:
    return (
        f"{begin} up to {100 * miss.metres:.1f} cm off (frame {miss.frame}), by more than {100 * noted:g} cm in"
        f" {miss.frames} of {miss.of_frames} frames"
    )
