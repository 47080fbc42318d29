"""Targets of hands and feet that reach: a walk is led near them, trunk and limb are made anew around the moment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.shots.request import Reach
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.kinematics.arm_aims import bend_within, find_out, lead_about
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals, widen
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton
from mapctl.terms.keep_clear import WithinReach

AROUND_FRAMES = 27
"""Frames at PRIOR_FPS before and after a reach in which trunk and limb are free."""
EASY_SHARE = 0.9
"""Share of a stretched limb's length that it reaches without strain."""
STRETCHED_SHARE = 0.97
"""Share of its length that a limb is stretched toward what it cannot reach."""
_BENT_SHARE = 0.85  # of its length, from which on the way to a place is shortened
_LEAN = 0.05  # metres that leaning adds to what a limb reaches
_TOLERANCE_SHARE = 0.9  # of a tolerance that is made use of
_TRUNK = list(CANONICAL.indices(("spine", "chest", "neck", "head")))


@dataclass(frozen=True, eq=False)
class ReachTargets:
    """Targets of a shot by frame."""

    targets: EffectorTargets
    """World positions of hands and feet."""
    tolerances: Float[Tensor, "frames joints"]
    """How far from there they may be, metres."""

    @staticmethod
    def of(reaches: Sequence[Reach], frames: int) -> "ReachTargets":
        """Collect the targets of all reaches."""
        places = torch.zeros(frames, CANONICAL.num_joints, 3, dtype=torch.float64)
        wanted = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.bool)
        tolerances = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.float64)
        for reach in reaches:
            first = min(round(reach.seconds * PRIOR_FPS), frames - 1)
            held = slice(first, first + round(reach.hold_seconds * PRIOR_FPS) + 1)
            for name, place in reach.places.items():
                places[held, CANONICAL.index(name)] = places.new_tensor(place)
                wanted[held, CANONICAL.index(name)] = True
                tolerances[held, CANONICAL.index(name)] = reach.tolerance_of(name)
        return ReachTargets(EffectorTargets(places, wanted), tolerances)

    def relaxed(self, motion: Motion) -> "ReachTargets":
        """Return targets as much nearer to where limbs are anyway as their tolerances allow."""
        toward = motion.joint_positions() - self.targets.places
        far = toward.norm(dim=-1).clamp_min(1e-6)
        share = (_TOLERANCE_SHARE * self.tolerances / far).clamp(max=1.0)
        return self._at(self.targets.places + share[..., None] * toward)

    def terms(self, skeleton: Skeleton, first: int, frames: int) -> list[WithinReach]:
        """Build the terms that lead a walk near enough, for frames of the shot; lengths are of the skeleton's size."""
        found = []
        for name, limb in LIMBS.items():
            window = slice(first, first + frames)
            wanted = self.targets.wanted[window, limb.end]
            if not bool(wanted.any()):
                continue
            missing = frames - len(wanted)  # look-ahead beyond the shot's end
            place = torch.cat([self.targets.places[window, limb.end], torch.zeros(missing, 3, dtype=torch.float64)])
            wished = torch.cat([wanted, wanted.new_zeros(missing)])
            term = WithinReach(limb.upper, place, wished, EASY_SHARE * limb.length(skeleton))
            found.append(replace(term, name=f"{name} within reach"))
        return found

    def within_reach(self, motion: Motion) -> "ReachTargets":
        """Return the targets that limbs reach from where a motion comes; of a limb that reaches none of its targets,
        the nearest one, brought as near as the limb reaches."""
        places, wanted, positions = self.targets.places.clone(), self.targets.wanted.clone(), motion.joint_positions()
        for limb in LIMBS.values():
            away = places[:, limb.end] - positions[:, limb.upper]
            most = STRETCHED_SHARE * limb.length(motion.skeleton) + _LEAN
            far = away.norm(dim=-1)
            for _, first, last in true_intervals(wanted[:, limb.end : limb.end + 1].clone()):
                reached = far[first:last] <= most
                if not bool(reached.any()):
                    reached[far[first:last].argmin()] = True
                wanted[first:last, limb.end] = reached
            near = positions[:, limb.upper] + away * (most / far.clamp_min(1e-6)).clamp(max=1.0)[:, None]
            places[:, limb.end] = near
        return replace(self, targets=EffectorTargets(places, wanted))

    def led_there(self, motion: Motion) -> "ReachTargets":
        """Return targets in all frames around a reach: from where limbs are, smoothly to the place and back.

        Told of the place alone, an in-betweener that never saw such a reach goes there at the last moment. The way is
        about the shoulder, its direction and its distance by themselves: a straight one may lead through the body.
        """
        places, wanted, positions = self.targets.places.clone(), self.targets.wanted.clone(), motion.joint_positions()
        frame = torch.arange(len(wanted))
        for name, limb in LIMBS.items():
            reached, out = self.targets.wanted[:, limb.end], find_out(name, positions)
            shoulder = positions[:, limb.upper]
            bones = limb.length(motion.skeleton)
            way = positions[:, limb.end] - shoulder
            for _, first, last in true_intervals(reached[:, None].clone()):
                away = (first - frame).clamp_min(0) + (frame - last + 1).clamp_min(0)
                share = smootherstep((1 - away / (AROUND_FRAMES + 1)).to(way))
                aim = places[frame.clamp(first, last - 1), limb.end] - shoulder
                aim = bend_within(aim, bones, easy=_BENT_SHARE, most=STRETCHED_SHARE)
                way = torch.where(share[:, None] > 0, lead_about(way, aim, share, out=out), way)
            near = widen(reached, AROUND_FRAMES)
            places[:, limb.end] = torch.where(reached[:, None], places[:, limb.end], shoulder + way)
            wanted[:, limb.end] = near
        return replace(self, targets=EffectorTargets(places, wanted))

    def _at(self, places: Float[Tensor, "frames joints 3"]) -> "ReachTargets":
        return replace(self, targets=EffectorTargets(places, self.targets.wanted))

    def free_limbs(self, joints: int, posed: Bool[Tensor, " frames"]) -> MissingMask:
        """Return what the in-betweener makes anew: trunk and limb around every reach, but in `posed` frames."""
        frames = len(self.targets.wanted)
        free = torch.zeros(frames, joints, dtype=torch.bool)
        for name, limb in LIMBS.items():
            near = widen(self.targets.wanted[:, limb.end], AROUND_FRAMES)
            own = [CANONICAL.parents[limb.upper], limb.upper, limb.lower, limb.end]
            freed = own + _TRUNK if name.endswith("Hand") else own[1:]
            free[:, freed] |= (near & ~posed)[:, None]
        return MissingMask(free, torch.zeros(frames, dtype=torch.bool))


def settle_reaches(reaches: Sequence[Reach], motion: Motion) -> tuple[Reach, ...]:
    """Return reaches at the times, within the frames that each allows, at which their limbs are nearest to there."""
    positions, found = motion.joint_positions(), []
    for reach in reaches:
        if not reach.within_frames:
            found.append(reach)
            continue
        hold, at = round(reach.hold_seconds * PRIOR_FPS), round(reach.seconds * PRIOR_FPS)
        first = max(0, at - reach.within_frames)
        last = min(motion.num_frames - 1 - hold, at + reach.within_frames)
        away = torch.stack(
            [
                (positions[:, CANONICAL.index(name)] - positions.new_tensor(place)).norm(dim=-1)
                for name, place in reach.places.items()
            ]
        ).sum(dim=0)
        best = first + int(away[first : max(first, last) + 1].argmin())
        found.append(replace(reach, seconds=best / PRIOR_FPS))
    return tuple(found)
