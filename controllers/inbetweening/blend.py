"""Tertiary blending (Kaufmann et al. 2020, section 4.2): a hand or foot moves for a while as in another motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import torch
from torch import Tensor

from controllers.inbetweening.feasibility import MIN_JERK_PEAK_ACCELERATION
from controllers.inbetweening.keyframes import effector_joint
from controllers.inbetweening.pipeline import InfillSettings, fill
from controllers.inbetweening.solution import InbetweenSolution
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask, restore_observed
from mapctl.kinematics import heading, inverse
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget import from_canonical, to_canonical
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig
from mapctl.retarget.stance import Stance
from mapctl.skeleton import CANONICAL, LIMBS, Limb
from mapctl.terms import Term

_MIN_MARGIN_SECONDS = 0.3  # seconds
_USUAL_HAND_ACCELERATION, _MAX_HAND_ACCELERATION = 20.0, 80.0  # m/s^2 of a hand


@dataclass(frozen=True)
class LimbTransfer:
    """What is taken, and where it goes."""

    limbs: tuple[str, ...]
    """Hands and feet, by the names of the rig that gets them."""
    start: int
    """First frame of the source that is taken, of its own frames."""
    stop: int
    """One past the last."""
    at: int
    """Frame of the motion that the first one goes to."""
    margin: float | None = None
    """Seconds before and after in which the limb is free to go there and back; as the distance asks for, if None."""


def blend(
    motion: Motion,
    source: Motion,
    borrowed: LimbTransfer,
    inbetweener: Inbetweener,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
) -> InbetweenSolution:
    """Put limbs of a motion where the source's are, seen from shoulder or hip, in size, and bent as those are; all else
    stays to the bit. In the margins before and after, the limbs go there and come back.

    What is taken lasts as long as it does in the source, whatever the two frame rates. RequestError for frames that
    either motion has not, and for joints that are no hand or foot; margins that no limb could do in time are named in
    the status, which is then infeasible.
    """
    _check_transfer(source, borrowed)
    own, rigmap = to_canonical(motion, rig)
    carried = retarget_motion(source, RiggedCharacter(rigmap, Stance.of(own, rigmap)))
    other = _resample_source(carried.motion, borrowed, motion.fps)
    borrowed = replace(borrowed, start=0, stop=other.num_frames)
    _check_destination(motion, borrowed)
    limbs = [LIMBS[CANONICAL.names[effector_joint(name, rigmap)]] for name in borrowed.limbs]
    there = slice(borrowed.at, borrowed.at + borrowed.stop - borrowed.start)
    posed = own
    for limb in limbs:
        posed = _copy_limb(posed, own, other, limb, borrowed)
    before, after = _compute_margins(own, posed, limbs, there, borrowed.margin)
    free = slice(max(0, there.start - before), min(motion.num_frames, there.stop + after))
    joints = [rigmap.joint_of[joint] for limb in limbs for joint in (limb.upper, limb.lower, limb.end)]
    new = torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool)
    new[there] = True
    moved = torch.zeros_like(new)
    moved[:, [joint for joint in joints if joint is not None]] = True
    nothing = torch.zeros(motion.num_frames, dtype=torch.bool)
    lent = restore_observed(from_canonical(posed, rigmap, motion), motion, MissingMask(new & moved, nothing))
    lost = torch.zeros_like(new)
    lost[free] = True
    lost[there] = False
    missing = MissingMask(lost & moved, nothing)
    done = fill(lent, missing, inbetweener, settings=settings, densities=densities, terms=terms, rig=rig)
    infeasible = _note_infeasible_margins(own, posed, borrowed, limbs, free, there)
    status = done.status.with_notes(carried.notes).with_notes(infeasible, infeasible=bool(infeasible))
    status = status.with_notes([f"frames {free.start}:{free.stop} of {', '.join(borrowed.limbs)} are new"])
    return replace(done, missing=MissingMask((lost | new) & moved, nothing), status=status)


def _resample_source(source: Motion, borrowed: LimbTransfer, fps: Fraction) -> Motion:
    """The frames that are borrowed, at another rate."""
    wanted = max(1, round((borrowed.stop - borrowed.start) * fps / source.fps))
    # To the frame after the last, where there is one: at a higher rate some frames lie between the two.
    taken = source.slice(borrowed.start, min(borrowed.stop + 1, source.num_frames)).resample(fps)
    return taken.slice(0, min(wanted, taken.num_frames))


def _copy_limb(posed: Motion, own: Motion, other: Motion, limb: Limb, borrowed: LimbTransfer) -> Motion:
    """With one limb bent as the source's is, which is of the same bones, seen from the heading of the hips, and its end
    as far from its root.
    """
    there = slice(borrowed.at, borrowed.at + borrowed.stop - borrowed.start)
    here = slice(borrowed.start, borrowed.stop)
    part, theirs = own.slice(there.start, there.stop), other.slice(here.start, here.stop)
    turn = rotations.about_y(heading(part.local_quat_xyzw[:, 0]) - heading(theirs.local_quat_xyzw[:, 0]))
    places, quats = theirs.joint_positions(), part.local_quat_xyzw.clone()
    world, given = part.joint_rotations(), theirs.joint_rotations()
    above = world[:, CANONICAL.parents[limb.upper]]
    for joint in (limb.upper, limb.lower, limb.end):
        wanted = rotations.multiply(turn, given[:, joint])
        quats[:, joint] = rotations.multiply(rotations.inverse(above), wanted)
        above = wanted
    bent = replace(part, local_quat_xyzw=quats)
    goals = bent.joint_positions().clone()
    way = rotations.rotate(turn, places[:, limb.end] - places[:, limb.upper])
    goals[:, limb.end] = goals[:, limb.upper] + way
    free = torch.zeros(goals.shape[:2], dtype=torch.bool)
    free[:, [limb.upper, limb.lower]] = True
    solved = inverse.solve_inverse_kinematics(
        goals, quats, own.skeleton, free=free, limbs=(limb,), root_position=part.root_position
    )
    whole = posed.local_quat_xyzw.clone()
    whole[there] = torch.where(free[..., None] | _make_joint_mask(limb.end), solved, whole[there])
    whole[there, limb.end] = quats[:, limb.end]
    return replace(posed, local_quat_xyzw=rotations.make_sign_continuous(whole))


def _make_joint_mask(joint: int) -> Tensor:
    return (torch.arange(CANONICAL.num_joints) == joint)[None, :, None]


def _compute_margins(
    own: Motion, posed: Motion, limbs: Sequence[Limb], there: slice, asked: float | None
) -> tuple[int, int]:
    """Frames before and after in which limbs go there and back: as asked, or as long as they take so far without
    haste.
    """
    fps, found = float(own.fps), []
    for frame in (there.start, there.stop - 1):
        way = (posed.slice(frame, frame + 1).joint_positions() - own.slice(frame, frame + 1).joint_positions())[0]
        far = max(float(way[limb.end].norm()) for limb in limbs)
        found.append(
            round(
                fps
                * (
                    max(_MIN_MARGIN_SECONDS, math.sqrt(MIN_JERK_PEAK_ACCELERATION * far / _USUAL_HAND_ACCELERATION))
                    if asked is None
                    else asked
                )
            )
        )
    return found[0], found[1]


def _note_infeasible_margins(
    own: Motion, posed: Motion, borrowed: LimbTransfer, limbs: Sequence[Limb], free: slice, there: slice
) -> tuple[str, ...]:
    """A word on limbs that have to go far in little time, with numbers."""
    notes, fps = [], float(own.fps)
    for frame, count in ((there.start, there.start - free.start), (there.stop - 1, free.stop - there.stop)):
        way = (posed.slice(frame, frame + 1).joint_positions() - own.slice(frame, frame + 1).joint_positions())[0]
        for name, limb in zip(borrowed.limbs, limbs, strict=True):
            far, needed = (
                float(way[limb.end].norm()),
                MIN_JERK_PEAK_ACCELERATION * float(way[limb.end].norm()) * (fps / max(1, count)) ** 2,
            )
            if needed > _MAX_HAND_ACCELERATION:
                notes.append(
                    f"{name} goes {100 * far:.0f} cm in {count / fps:.2f} s beside frame {frame}, which takes "
                    f"{needed:.0f} m/s^2; {_MAX_HAND_ACCELERATION:.0f} is the most that is common: a margin of "
                    f"{math.sqrt(MIN_JERK_PEAK_ACCELERATION * far / _MAX_HAND_ACCELERATION):.2f} s would do"
                )
    return tuple(notes)


def _check_transfer(source: Motion, borrowed: LimbTransfer) -> None:
    if not borrowed.limbs:
        raise RequestError("blending needs a hand or a foot")
    if not 0 <= borrowed.start < borrowed.stop <= source.num_frames:
        raise RequestError(f"frames {borrowed.start}:{borrowed.stop} are not within the source's 0:{source.num_frames}")
    if borrowed.margin is not None and not 0 <= borrowed.margin <= 10:
        raise RequestError(f"the margin must lie between 0 and 10 seconds, got {borrowed.margin:g}")


def _check_destination(motion: Motion, borrowed: LimbTransfer) -> None:
    last = borrowed.at + borrowed.stop - borrowed.start
    if not 0 <= borrowed.at < last <= motion.num_frames:
        raise RequestError(f"frames {borrowed.at}:{last} are not within the motion's 0:{motion.num_frames}")
