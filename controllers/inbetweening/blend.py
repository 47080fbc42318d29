"""Tertiary blending (Kaufmann et al. 2020, section 4.2): a hand or foot moves as in another motion for some frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.keyframes import effector_joint
from controllers.inbetweening.pipeline import FillOptions, InbetweenSolution, fill
from controllers.inbetweening.tween import MIN_JERK_PEAK_ACCELERATION
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.effector_targets import bend_limb
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import MissingMask, restore_observed
from mapctl.retarget import from_canonical, to_canonical
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.retarget.character import Stance
from mapctl.skeleton import CANONICAL, LIMBS, Limb

_MIN_MARGIN_SECONDS = 0.3
_USUAL_HAND_ACCELERATION, _MAX_HAND_ACCELERATION = 20.0, 80.0  # m/s^2 of a hand


@dataclass(frozen=True)
class LimbTransfer:
    """Limbs and frames of a source, and their frames in the motion."""

    limbs: tuple[str, ...]
    """Hands and feet, by the names of the motion's rig."""
    start: int
    """First frame of the source, in its own frames."""
    stop: int
    """One past the last frame of the source."""
    at: int
    """Frame of the motion for the first frame of the source."""
    margin: float | None = None
    """Seconds before and after in which the limb is in-betweened; by its distance if None."""


def blend(
    motion: Motion, source: Motion, transfer: LimbTransfer, inbetweener: Inbetweener, **options: Unpack[FillOptions]
) -> InbetweenSolution:
    """Move limbs of a motion as the source's, relative to shoulder or hip, scaled, and bent alike; all else stays to
    the bit. In the margins before and after, the limbs are in-betweened.

    Durations are the source's at any two frame rates. RequestError for frames that either motion has not, and for
    joints that are no hand or foot; margins too short for any limb are named in the status, which is then infeasible.
    """
    if not transfer.limbs:
        raise RequestError("blending needs a hand or a foot")
    if not 0 <= transfer.start < transfer.stop <= source.num_frames:
        raise RequestError(f"frames {transfer.start}:{transfer.stop} are not within the source's 0:{source.num_frames}")
    if transfer.margin is not None and not 0 <= transfer.margin <= 10:
        raise RequestError(f"the margin must lie between 0 and 10 seconds, got {transfer.margin:g}")
    own, rigmap = to_canonical(motion, options.get("rig"))
    retargeted = retarget_motion(source, RiggedCharacter(rigmap, Stance.of(own, rigmap)))
    # To the frame after the last, where there is one: at a higher rate some frames lie between the two.
    taken = retargeted.motion.slice(transfer.start, min(transfer.stop + 1, source.num_frames)).resample(motion.fps)
    wanted = max(1, round((transfer.stop - transfer.start) * motion.fps / source.fps))
    other = taken.slice(0, min(wanted, taken.num_frames))
    there = slice(transfer.at, transfer.at + other.num_frames)
    if not 0 <= there.start < there.stop <= motion.num_frames:
        raise RequestError(f"frames {there.start}:{there.stop} are not within the motion's 0:{motion.num_frames}")
    limbs = [LIMBS[CANONICAL.names[effector_joint(name, rigmap)]] for name in transfer.limbs]
    posed = own
    for limb in limbs:
        posed = _copy_limb(posed, own, other, limb, there)
    # Limbs go there and back in the margin that is given, or by their distance at a usual acceleration.
    sides, ends = torch.tensor([there.start, there.stop - 1]), [limb.end for limb in limbs]
    targets, starts = (each.pick(sides).joint_positions()[:, ends] for each in (posed, own))
    distances, fps = (targets - starts).norm(dim=-1), float(own.fps)
    counts = []
    for far in distances.amax(dim=1).tolist():
        usual = max(_MIN_MARGIN_SECONDS, math.sqrt(MIN_JERK_PEAK_ACCELERATION * far / _USUAL_HAND_ACCELERATION))
        counts.append(round(fps * (usual if transfer.margin is None else transfer.margin)))
    free = slice(max(0, there.start - counts[0]), min(motion.num_frames, there.stop + counts[1]))
    joints = [rigmap.joint_of[joint] for limb in limbs for joint in (limb.upper, limb.lower, limb.end)]
    moved = torch.zeros(motion.num_joints, dtype=torch.bool)
    moved[[joint for joint in joints if joint is not None]] = True
    new, new_or_margin, nothing = torch.zeros(3, motion.num_frames, dtype=torch.bool)
    new[there] = new_or_margin[free] = True
    copied = MissingMask(new[:, None] & moved, nothing)
    transferred = restore_observed(from_canonical(posed, rigmap, motion), motion, copied)
    missing = MissingMask((new_or_margin & ~new)[:, None] & moved, nothing)
    done = fill(transferred, missing, inbetweener, **options)
    margins = (there.start, there.start - free.start), (there.stop - 1, free.stop - there.stop)
    infeasible = _note_infeasible_margins(transfer, distances, margins, fps)
    status = done.status.with_notes(retargeted.changes.notes).with_notes(infeasible, infeasible=bool(infeasible))
    status = status.with_notes([f"frames {free.start}:{free.stop} of {', '.join(transfer.limbs)} are new"])
    return replace(done, missing=MissingMask(new_or_margin[:, None] & moved, nothing), status=status)


def _copy_limb(posed: Motion, own: Motion, theirs: Motion, limb: Limb, there: slice) -> Motion:
    """Copy one limb of a source on the same bones: its orientations relative to the hips, and where its effector is."""
    part = own.slice(there.start, there.stop)
    turn = rotations.about_y(heading(part.local_quat_xyzw[:, 0]) - heading(theirs.local_quat_xyzw[:, 0]))
    positions, quats = theirs.joint_positions(), part.local_quat_xyzw.clone()
    world, given = part.joint_rotations(), theirs.joint_rotations()
    above = world[:, CANONICAL.parents[limb.upper]]
    for joint in (limb.upper, limb.lower, limb.end):
        wanted = rotations.multiply(turn, given[:, joint])
        quats[:, joint] = rotations.multiply(rotations.inverse(above), wanted)
        above = wanted
    turned = replace(part, local_quat_xyzw=quats)
    limb_vector = rotations.rotate(turn, positions[:, limb.end] - positions[:, limb.upper])
    ends = turned.joint_positions()[:, limb.upper] + limb_vector
    bent = bend_limb(turned, limb, ends, torch.ones(part.num_frames, dtype=torch.bool))
    whole, joints = posed.local_quat_xyzw.clone(), [limb.upper, limb.lower, limb.end]
    whole[there, joints] = bent.local_quat_xyzw[:, joints]
    return replace(posed, local_quat_xyzw=rotations.make_sign_continuous(whole))


def _note_infeasible_margins(
    transfer: LimbTransfer, distances: Float[Tensor, "sides limbs"], margins: Sequence[tuple[int, int]], fps: float
) -> list[str]:
    """Note limbs that are too fast over their distances, metres, in the margins: the frame beside each, and how many
    frames it has."""
    notes = []
    for (frame, count), row in zip(margins, distances.tolist(), strict=True):
        for name, distance in zip(transfer.limbs, row, strict=True):
            needed = MIN_JERK_PEAK_ACCELERATION * distance * (fps / max(1, count)) ** 2
            if needed > _MAX_HAND_ACCELERATION:
                notes.append(
                    f"{name} goes {100 * distance:.0f} cm in {count / fps:.2f} s beside frame {frame}, which takes "
                    f"{needed:.0f} m/s^2; {_MAX_HAND_ACCELERATION:.0f} is the most that is common: a margin of "
                    f"{math.sqrt(MIN_JERK_PEAK_ACCELERATION * distance / _MAX_HAND_ACCELERATION):.2f} s would do"
                )
    return notes
