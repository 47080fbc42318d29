"""Retargeting: motion of one performer on the bones of another, with the same contacts with the floor.

Rotations stay, but of legs: the hips go as far and as high as the legs' lengths and both ankles' heights ask for, each
toe joint is as high over its own rest height as the giver's over his, in scale, and while a foot is planted it moves as
little as the giver's. Two-bone inverse kinematics brings the legs there. (The footsteps are kept as in Gleicher 1998,
but joint by joint instead of by spacetime optimisation.)
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import contacts, kinematics, rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals
from mapctl.retarget import RigMap, as_rig, from_canonical, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.retarget.stance import SIDES, Stance
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton, leg_length

_HIP_JOINTS, _SHINS, _FEET, _TOES = (
    [CANONICAL.index(side + part) for side in SIDES] for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")
)
_MERGE_SECONDS = 0.2  # seconds between two contacts at one position that are one
_MERGE_METRES = 0.06  # metres that such contacts are apart at most
_FREE_EXTENSION = 0.985  # of the leg: a leg may be that straight, whatever the giver's is
_MAX_EXTENSION = 0.9995  # of the leg that one may be at most
_SOFT_MARGIN = 0.004  # of the leg, before the most that it may be, over which it gives in
_HIP_DROP_SECONDS = 0.12  # seconds over which hips go down for a leg that is too short, and up again
_MAX_TOE_SINK = 0.008  # metres under its rest height that a toe goes at most
_HEEL_DEG, _MAX_HEEL_DEG = 10.0, 60.0  # degrees that toes are raised by when a foot is on its heel, and at most
# Heights over the floor, of the leg: from the first on rotations count, from the second on they alone do.
_LOW_SHARE, _HIGH_SHARE = 0.1, 0.35
_SMOOTH_SECONDS = 0.05  # seconds over which what hips carry is smoothed
_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
_NOTED_METRES = 0.005  # metres that a foot misses its target by before it is worth a line


@dataclass(frozen=True, eq=False)
class RiggedCharacter:
    """The character that is to move: a rig with its performer's bones and stance."""

    rigmap: RigMap
    """The rig, and its bones on canonical joints."""
    stance: Stance
    """How the performer stands: toe heights, and tilt of the feet."""
    source: object | None = None
    """Layout and unit of the rig's file, which the result is written in."""

    @staticmethod
    def of(clip: Motion, rig: Rig | None = None) -> "tuple[Motion, RiggedCharacter]":
        """Return a clip on canonical joints, and its character; RequestError where its joints cannot be identified."""
        canonical, rigmap = to_canonical(clip, rig)
        return canonical, RiggedCharacter(rigmap, Stance.of(canonical, rigmap), clip.source)

    @property
    def skeleton(self) -> Skeleton:
        """Canonical names and tree with this performer's bones."""
        return self.rigmap.skeleton

    @cached_property
    def leveled_map(self) -> RigMap:
        """Between the rig and canonical joints whose T-pose has this performer's feet flat on the floor."""
        return self.stance.leveled_map(self.rigmap)

    @property
    def leveled(self) -> Skeleton:
        """Canonical skeleton with this performer's bones in the T-pose whose feet lie flat."""
        return self.leveled_map.skeleton

    def on_rig(self, motion: Motion) -> Motion:
        """Put a canonical motion of this body on its rig, in its file's layout; joints that are not canonical rest."""
        return replace(from_canonical(motion, self.rigmap), source=self.source)


@dataclass(frozen=True, eq=False)
class RetargetedMotion:
    """A motion on another body."""

    motion: Motion
    """On canonical joints, with the bones of the body."""
    notes: tuple[str, ...] = ()
    """What could not be kept; empty where all is."""


def retarget_motion(clip: Motion, body: RiggedCharacter, rig: Rig | None = None) -> RetargetedMotion:
    """Retarget a clip of any rig to a body's bones, in the canonical joint frames of its rig.

    A clip of the body's own skeleton comes as it is, to the bit. `rig` is the clip's, where it is not the one that
    would be recognised. RequestError where its joints cannot be identified.
    """
    if clip.skeleton.matches(body.rigmap.rig_skeleton):
        return RetargetedMotion(replace(to_canonical(clip, as_rig(body.rigmap))[0], skeleton=body.skeleton))
    canonical, giver = RiggedCharacter.of(clip, rig)
    return retarget_canonical(canonical, giver, body)


def retarget_canonical(motion: Motion, giver: RiggedCharacter, body: RiggedCharacter) -> RetargetedMotion:
    """Retarget a motion (canonical joints, any part of a clip) whose giver is known."""
    own = giver.stance.leveled(motion)
    scale = leg_length(body.leveled) / leg_length(own.skeleton)
    moved = _transfer_root(own, giver, body, scale)
    ankles = _ankle_targets(own, moved, giver.stance, body.stance, scale)
    moved = _lower_hips(moved, ankles, _leg_extension(own))
    done = _reach_ankle_targets(moved, ankles)
    return RetargetedMotion(body.stance.restore_foot_tilt(done), _note_ankle_errors(done, ankles))


def _transfer_root(own: Motion, giver: RiggedCharacter, body: RiggedCharacter, scale: float) -> Motion:
    """Put the giver's rotations on the body's bones. The middle between the thighs follows its trajectory in scale, as
    much higher as ankles and floor ask for."""
    to_thighs = body.leveled.offsets[_HIP_JOINTS].mean(0) - scale * own.skeleton.offsets[_HIP_JOINTS].mean(0)
    turns = own.joint_rotations()[:, 0]
    # The hips' rotation is noisy; what they carry at another distance is not to shake for it.
    aside = _low_pass(rotations.rotate(turns, to_thighs.expand(own.num_frames, 3)), _SMOOTH_SECONDS * float(own.fps))
    ankle, others = (
        _ankle_height(body.stance.toe_height, body.leveled),
        _ankle_height(giver.stance.flat_height, own.skeleton),
    )
    rise = _UP * (ankle - scale * others + (1 - scale) * giver.stance.floor)
    return replace(own, skeleton=body.leveled, root_position=scale * own.root_position + rise - aside, source=None)


def _ankle_height(toe_height: Float[Tensor, "2"], leveled: Skeleton) -> Float[Tensor, ""]:
    """Return the height of the ankles over the floor while feet lie flat, metres, mean of both."""
    return (toe_height - leveled.offsets[_TOES, 1]).mean()


def _ankle_targets(
    own: Motion, moved: Motion, giver: Stance, body: Stance, scale: float
) -> Float[Tensor, "frames 2 3"]:
    """Return target ankle positions, metres: toe joints as the giver's in scale, over their own rest heights, and moved
    over the ground to where the body's rotations bring them, by as much throughout a contact. High over the floor
    rotations alone count: a kick is a pose, not a position."""
    toes, places = own.joint_positions()[:, _TOES], scale * own.joint_positions()[:, _FEET]
    shift = moved.joint_positions()[:, _TOES] - scale * toes
    for k, spans in enumerate(_contact_intervals(toes, own.fps)):
        places[:, k, ::2] += _hold_through_contacts(shift[:, k, ::2], spans, float(own.fps))
    over = scale * (toes[..., 1] - giver.floor - giver.flat_height)
    lifted = torch.where(over < 0, _MAX_TOE_SINK * torch.expm1(over / _MAX_TOE_SINK) - over, 0.0)
    places[..., 1] += (1 - scale) * giver.floor + body.toe_height - scale * giver.flat_height + lifted
    high = smootherstep(over / leg_length(moved.skeleton) / _HIGH_SHARE - _LOW_SHARE / _HIGH_SHARE)[..., None]
    return torch.lerp(places + _foot_length_offset(own, moved, scale), moved.joint_positions()[:, _FEET], high)


def _foot_length_offset(own: Motion, moved: Motion, scale: float) -> Float[Tensor, "frames 2 3"]:
    """Return the offset of the ankle from where it would be if the foot were the giver's in scale, metres.

    A foot whose heel is raised pivots on its toes, one whose toes are raised on its heel, right below the ankle: then
    the ankle follows the giver's trajectory, as if the foot were flat.
    """
    longer = (scale * own.skeleton.offsets - moved.skeleton.offsets)[_TOES].expand(own.num_frames, 2, 3)
    turns = own.joint_rotations()[:, _FEET]
    heading, tilt = rotations.split_heading(turns)
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(longer)
    rises = (rotations.rotate(turns, axis)[..., 1] for axis in (forward, forward.roll(-1, -1)))
    up = torch.rad2deg(torch.atan2(*rises))
    on_toes = 1 - smootherstep(up / _HEEL_DEG) * (1 - smootherstep((up - _MAX_HEEL_DEG) / _MAX_HEEL_DEG))
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand_as(tilt)
    tilt = rotations.slerp(still, tilt, on_toes)
    return rotations.rotate(rotations.multiply(rotations.about_y(heading), tilt), longer)


def _contact_intervals(toes: Float[Tensor, "frames 2 3"], fps) -> list[list[tuple[int, int]]]:
    """Return by foot the first frames of contacts and one past their last, merged where noise alone parts them."""
    intervals, apart = list(true_intervals(contacts.detect_contacts(toes, fps))), _MERGE_SECONDS * float(fps)
    by_foot = ([(start, stop) for foot, start, stop in intervals if foot == k] for k in range(toes.shape[1]))
    return [_merge_contacts(spans, toes[:, k], apart) for k, spans in enumerate(by_foot)]


def _merge_contacts(runs: list[tuple[int, int]], toe: Float[Tensor, "frames 3"], apart: float) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    for start, stop in runs:
        near = bool(found) and start - found[-1][1] < apart
        if near and float((toe[start] - toe[found[-1][1] - 1])[::2].norm()) < _MERGE_METRES:
            found[-1] = (found[-1][0], stop)
        else:
            found.append((start, stop))
    return found


def _hold_through_contacts(
    shift: Float[Tensor, "frames 2"], spans: list[tuple[int, int]], fps: float
) -> Float[Tensor, "frames 2"]:
    """Hold the shift at its mean throughout each span, smooth between spans; low-pass it without any span."""
    if not spans:
        return _low_pass(shift, 0.25 * fps)
    held = torch.empty_like(shift)
    values = [shift[start:stop].mean(0) for start, stop in spans]
    held[: spans[0][0]], held[spans[-1][0] :] = values[0], values[-1]
    for (start, stop), value in zip(spans, values, strict=True):
        held[start:stop] = value
    for (_, stop), (start, _), before, after in zip(spans[:-1], spans[1:], values[:-1], values[1:], strict=True):
        share = torch.arange(1, start - stop + 1, dtype=shift.dtype)[:, None] / (start - stop + 1)
        held[stop:start] = before + (after - before) * smootherstep(share)
    return held


def _low_pass(values: Float[Tensor, "frames columns"], sigma: float) -> Float[Tensor, "frames columns"]:
    """Low-pass values over time by a Gaussian of `sigma` frames; ends are held."""
    taps = gaussian.kernel(max(sigma, 1e-6), side=max(1, round(3 * sigma)))
    return gaussian.convolve(values, taps, "repeated")


def _leg_extension(own: Motion) -> Float[Tensor, "frames 2"]:
    """Return how straight the giver's legs are: hip joint to ankle over both bones' length."""
    places = own.joint_positions()
    return (places[:, _FEET] - places[:, _HIP_JOINTS]).norm(dim=-1) / _leg_bone_lengths(own.skeleton)


def _leg_bone_lengths(skeleton: Skeleton) -> Float[Tensor, "2"]:
    return torch.tensor([LIMBS[side + "Foot"].length(skeleton) for side in SIDES], dtype=torch.float64)


def _lower_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Lower hips smoothly until legs reach the ankles' targets no straighter than the giver's, or than most."""
    to_ankles = ankles - moved.joint_positions()[:, _HIP_JOINTS]
    most = _leg_bone_lengths(moved.skeleton) * stretch.clamp(_FREE_EXTENSION, _MAX_EXTENSION)
    level, down = to_ankles[..., ::2].square().sum(-1), -to_ankles[..., 1]
    # The height at which the leg just reaches; a leg that points sideways or up is not helped by lower hips.
    short = (down - (most.square() - level).clamp_min(0).sqrt()).clamp_min(0)
    short = torch.where(down > 0.5 * most, short, 0.0).amax(dim=-1, keepdim=True)
    frames = max(1, round(_HIP_DROP_SECONDS * float(moved.fps)))
    padded = torch.nn.functional.pad(short.T[None], (frames, frames), mode="replicate")
    highest = torch.nn.functional.max_pool1d(padded, 2 * frames + 1, stride=1)[0].T
    dip = _low_pass(highest, frames / 2)[:, 0]
    return replace(moved, root_position=moved.root_position - dip[:, None] * _UP)


def _reach_ankle_targets(moved: Motion, ankles: Float[Tensor, "frames 2 3"]) -> Motion:
    """Bend and rotate legs so that ankles reach their targets; feet keep their orientation in the world."""
    places, world = moved.joint_positions().clone(), moved.joint_rotations()
    at, most = places[:, _HIP_JOINTS], _MAX_EXTENSION * _leg_bone_lengths(moved.skeleton)
    to_ankles = ankles - at
    far = to_ankles.norm(dim=-1)
    places[:, _FEET] = at + to_ankles * (_soft_clamp(far, most) / far.clamp_min(1e-9))[..., None]
    free = torch.zeros(places.shape[:2], dtype=torch.bool)
    free[:, [*_HIP_JOINTS, *_SHINS]] = True
    legs = [LIMBS[side + "Foot"] for side in SIDES]
    local = inverse.solve_inverse_kinematics(
        places, moved.local_quat_xyzw, moved.skeleton, free=free, root_position=moved.root_position, limbs=legs
    )
    turned = replace(moved, local_quat_xyzw=local).joint_rotations().clone()
    turned[:, [*_FEET, *_TOES]] = world[:, [*_FEET, *_TOES]]
    local = rotations.make_sign_continuous(kinematics.local_from_world(moved.skeleton.parents, turned))
    return replace(moved, local_quat_xyzw=local)


def _soft_clamp(far: Float[Tensor, "frames 2"], most: Float[Tensor, "2"]) -> Float[Tensor, "frames 2"]:
    """Return how far an ankle may be: as far as it is, and ever less beyond what is nearly the most."""
    soft = _SOFT_MARGIN * most
    over = (far - (most - soft)).clamp_min(0)
    return torch.minimum(far, most - soft) + soft * (1 - torch.exp(-over / soft))


def _note_ankle_errors(done: Motion, ankles: Float[Tensor, "frames 2 3"]) -> tuple[str, ...]:
    """Return a note on feet that miss their targets; none where they all reach them."""
    off = (done.joint_positions()[:, _FEET] - ankles).norm(dim=-1).amax(dim=-1)
    if float(off.max()) < _NOTED_METRES:
        return ()
    frames, worst = int((off > _NOTED_METRES).sum()), int(off.argmax())
    return (
        f"the legs are too short for some of the way: feet are up to {100 * float(off.max()):.1f} cm off"
        f" (frame {worst}), by more than {100 * _NOTED_METRES:g} cm in {frames} of {len(off)} frames",
    )
