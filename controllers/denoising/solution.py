"""The result of denoising: a motion with its faults, corrections and uncertainty; parts of it, and parts joined."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.density_selection import DensityInterval
from mapctl.problem.solution import Outcome, Solution
from mapctl.recording.inspection import Artefact
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

Part = TypeVar("Part", Artefact, DensityInterval)
_FALLBACK_SHARE = 0.5  # share of a joint's frames from which the network counts as out of its depth


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class DenoiseSolution(Solution):
    """Clean motion on the capture's rig, at its rate, with artefacts and corrections."""

    capture: Motion
    """The capture as given."""
    noise: Float[Tensor, " joints"]
    """Estimated noise of each of a joint's angles, by joint of the rig, radians."""
    noise_root: float
    """Estimated noise of each coordinate of the root position, metres."""
    faults: tuple[Artefact, ...]
    """All artefacts found."""
    contacts: Bool[Tensor, "frames 2"]
    """Contacts of the left and the right toe, at PRIOR_FPS."""
    proposal_share: Float[Tensor, "frames canonical"]
    """By frame at PRIOR_FPS and canonical joint: 1 where the proposal was used, 0 where the smoothed capture was."""
    error: Float[Tensor, "frames canonical"]
    """Estimated error that remains in each of a joint's angles, in the same frames, radians (standard deviation)."""
    drift: float | None = None
    """Speed at which standing toes slid in the capture, m/s, where its trajectory was corrected by them."""
    rig: Rig | None = None
    """The rig as it was identified."""
    density_intervals: tuple[DensityInterval, ...] = ()
    """Density and its weight in each window, in frames of the capture; empty where none was given."""

    def assess(self) -> "DenoiseSolution":
        """Return the solution whose status is that the network was out of its depth where it was in more than half; of
        a capture from video it proposes nothing that was observed."""
        used = float(self.proposal_share.mean()) >= _FALLBACK_SHARE or self.drift is not None
        out_of_depth = not used and bool(self.noise.max() > 0)
        outcome = Outcome.OUT_OF_DEPTH if out_of_depth else Outcome.DONE
        return replace(self, status=replace(self.status, outcome=outcome))

    def slice(self, start: int, stop: int) -> "DenoiseSolution":
        """Return frames start to stop with their artefacts; the noise stays that of the whole."""
        ratio = PRIOR_FPS / float(self.motion.fps)
        part = slice(round(start * ratio), round(stop * ratio))
        return replace(
            self,
            motion=self.motion.slice(start, stop),
            capture=self.capture.slice(start, stop),
            faults=move_frames(self.faults, -start, stop=stop - start),
            density_intervals=move_frames(self.density_intervals, -start, stop=stop - start),
            ledger=self.ledger.pick(part),
            **{name: values[part] for name, values in self.by_frame.items()},
        )

    @property
    def by_frame(self) -> dict[str, Tensor]:
        """What there is for each frame at PRIOR_FPS."""
        return {name: getattr(self, name) for name in ("contacts", "proposal_share", "error")}

    def details(self) -> dict[str, Any]:
        """Return noise, faults, corrections, contacts, fallbacks and densities, and compute of each frame."""
        names, (moved, turned) = self.motion.skeleton.names, self.correction()
        contacts = self._list_frames(self.contacts)
        return {
            "rig": None if self.rig is None else self.rig.name,
            "noise_deg": dict(zip(names, torch.rad2deg(self.noise).tolist(), strict=True)),
            "noise_root_cm": 100 * self.noise_root,
            "drift_cm_s": None if self.drift is None else 100 * self.drift,
            "error_deg": dict(zip(CANONICAL.names, torch.rad2deg(self.error.mean(dim=0)).tolist(), strict=True)),
            "faults": [vars(fault) for fault in self.faults],
            "correction_cm": dict(zip(names, moved.tolist(), strict=True)),
            "correction_deg": dict(zip(names, turned.tolist(), strict=True)),
            "contacts": {
                side: [[start, stop] for foot, start, stop in contacts if foot == k]
                for k, side in enumerate(("left", "right"))
            },
            "fallback": [
                {"joint": CANONICAL.names[joint], "start": start, "stop": stop}
                for joint, start, stop in self._list_frames(self.proposal_share < _FALLBACK_SHARE)
            ],
            "densities": [vars(part) for part in self.density_intervals],
            "frame_ms": self.frame_ms,
        }

    @property
    def frame_ms(self) -> float:
        """Compute of each frame, milliseconds."""
        return 1000 * self.seconds / self.motion.num_frames

    def correction(self) -> tuple[Float[Tensor, " joints"], Float[Tensor, " joints"]]:
        """Compute by joint of the rig the mean distance it was moved by, cm, and the mean angle in its parent, deg."""
        turns = rotations.turns_between(self.capture.local_quat_xyzw, self.motion.local_quat_xyzw)
        angle = torch.rad2deg(turns.norm(dim=-1))
        return 100 * self._measure_moves().mean(dim=0), angle.mean(dim=0)

    def find_largest_move(self) -> tuple[str, int, float]:
        """Find the joint of the rig and the frame that were moved most, and by how many centimetres."""
        moved = self._measure_moves()
        frame, joint = divmod(int(moved.argmax()), moved.shape[1])
        return self.motion.skeleton.names[joint], frame, 100 * float(moved[frame, joint])

    def _measure_moves(self) -> Float[Tensor, "frames joints"]:
        return (self.motion.joint_positions() - self.capture.joint_positions()).norm(dim=-1)

    def _list_frames(self, mask: Bool[Tensor, "frames columns"]) -> list[tuple[int, int, int]]:
        """List runs by column of a mask at PRIOR_FPS, in frames of the capture."""
        scale, last = float(self.motion.fps) / PRIOR_FPS, self.motion.num_frames
        return [(k, round(start * scale), min(last, round(stop * scale))) for k, start, stop in true_intervals(mask)]


def move_frames(parts: Sequence[Part], by: int, start: int = 0, stop: int = sys.maxsize) -> tuple[Part, ...]:
    """Move parts by so many frames, and cut them to frames start to stop."""
    moved = [replace(part, start=max(part.start + by, start), stop=min(part.stop + by, stop)) for part in parts]
    return tuple(part for part in moved if part.start < part.stop)


def join_segments(pieces: Sequence[tuple[DenoiseSolution, int]]) -> DenoiseSolution:
    """Join pieces of one capture, each with the frame that it begins at; where two overlap the second fades in.

    By halves: one after the other each frame would be copied once for every piece.
    """
    if len(pieces) == 1:
        return pieces[0][0]
    middle = len(pieces) // 2
    first, second = join_segments(pieces[:middle]), join_segments(pieces[middle:])
    return _append_segment(first, second, pieces[middle][1] - pieces[0][1])


def _append_segment(whole: DenoiseSolution, piece: DenoiseSolution, start: int) -> DenoiseSolution:
    """Append a piece that begins at frame `start` of the whole."""
    shared = whole.motion.num_frames - start
    motion = crossfade(whole.motion, piece.motion, shared)
    ratio, frames = PRIOR_FPS / float(motion.fps), motion.num_frames
    skip = start + shared // 2
    kept = round(skip * ratio)
    skipped = kept - round(start * ratio)
    later = move_frames(piece.density_intervals, start, skip, frames)
    share = piece.motion.num_frames / frames
    return replace(
        whole,
        motion=motion,
        capture=whole.capture.join(piece.capture.slice(shared, piece.capture.num_frames)),
        noise=(1 - share) * whole.noise + share * piece.noise,
        noise_root=(1 - share) * whole.noise_root + share * piece.noise_root,
        faults=_merge_faults(move_frames(whole.faults, 0, stop=skip), move_frames(piece.faults, start, skip, frames)),
        **{name: torch.cat([values[:kept], getattr(piece, name)[skipped:]]) for name, values in whole.by_frame.items()},
        ledger=whole.ledger.pick(slice(kept)).join(piece.ledger.pick(slice(skipped, None))),
        seconds=whole.seconds + piece.seconds,
        windows=whole.windows + piece.windows,
        status=replace(whole.status, notes=tuple(dict.fromkeys(whole.notes + piece.notes))),
        density_intervals=(*move_frames(whole.density_intervals, 0, stop=skip), *later),
    )


def _merge_faults(before: Sequence[Artefact], after: Sequence[Artefact]) -> tuple[Artefact, ...]:
    """Merge faults; what ends where the same goes on is one fault, as bad as the worse of the two."""
    ends = {(fault.joint, fault.kind, fault.unit, fault.stop): number for number, fault in enumerate(before)}
    chained = list(before)
    for fault in after:
        number = ends.get((fault.joint, fault.kind, fault.unit, fault.start))
        if number is None:
            chained.append(fault)
        else:
            amount = max(chained[number].amount, fault.amount)
            chained[number] = replace(chained[number], stop=fault.stop, amount=amount)
    return tuple(chained)


def crossfade(before: Motion, after: Motion, shared: int) -> Motion:
    """Join two motions; the second fades in over `shared` frames, the last of the first and the first of its own."""
    if shared == 0:
        return before.join(after)
    first = before.num_frames - shared
    weight = torch.linspace(0, 1, shared, dtype=torch.float64)
    tail, head = before.slice(first, before.num_frames), after.slice(0, shared)
    mixed = replace(
        tail,
        root_position=torch.lerp(tail.root_position, head.root_position, weight[:, None]),
        local_quat_xyzw=rotations.slerp(
            tail.local_quat_xyzw, head.local_quat_xyzw, weight[:, None].expand(shared, before.num_joints)
        ),
        moving_offsets={
            joint: torch.lerp(values, head.moving_offsets[joint], weight[:, None])
            for joint, values in tail.moving_offsets.items()
        },
    )
    parts = [before.slice(0, first)] if first > 0 else []
    parts += [mixed, after.slice(shared, after.num_frames)] if shared < after.num_frames else [mixed]
    return reduce(Motion.join, parts)
