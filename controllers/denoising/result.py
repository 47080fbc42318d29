"""What denoising gives back: the clean motion, what was found wrong, what was changed, and how sure it is."""

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
from mapctl.problem.ledger import Ledger
from mapctl.recording.artefacts import Artefact
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

Part = TypeVar("Part", Artefact, DensityInterval)
_FALLBACK_SHARE = 0.5  # share of a joint's frames from which the network counts as out of its depth


@dataclass(frozen=True, eq=False)
class DenoiseResult:
    """A clean motion, and what was found and changed."""

    motion: Motion
    """On the capture's rig, at its rate."""
    capture: Motion
    """As it came."""
    noise: Float[Tensor, " joints"]
    """Of each of a joint's angles, by joint of the rig, radians."""
    noise_root: float
    """Of each coordinate of the root's place, metres."""
    faults: tuple[Artefact, ...]
    """Everything that was found wrong."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted, at the prior's rate."""
    proposal_share: Float[Tensor, "frames canonical"]
    """By frame at the prior's rate and canonical joint: 1 where the proposal was followed, 0 where the capture itself,
    smoothed, took its place."""
    ledger: Ledger
    """Of the MAP stage, by term and frame at the prior's rate."""
    rig: Rig | None = None
    """The rig as it was told."""
    seconds: float = 0.0
    """Compute, wall clock."""
    notes: tuple[str, ...] = ()
    """What the user should know."""
    stretches: tuple[DensityInterval, ...] = ()
    """Of each window of the MAP stage, in frames of the capture, which density counted and how much; none where none
    was given."""

    def slice(self, start: int, stop: int) -> "DenoiseResult":
        """Frames start to stop, with what was wrong in them; the noise stays that of the whole."""
        ratio = PRIOR_FPS / float(self.motion.fps)
        part = slice(round(start * ratio), round(stop * ratio))
        faults = _shift_frames(_clip_to_frames(self.faults, start, stop), -start)
        return replace(
            self,
            motion=self.motion.slice(start, stop),
            capture=self.capture.slice(start, stop),
            faults=tuple(faults),
            contacts=self.contacts[part],
            proposal_share=self.proposal_share[part],
            stretches=tuple(_shift_frames(_clip_to_frames(self.stretches, start, stop), -start)),
            ledger=_slice_ledger(self.ledger, part),
        )

    def summary(self) -> dict[str, Any]:
        """For a report, in plain numbers."""
        names = self.motion.skeleton.names
        moved, turned = self.correction()
        return {
            "rig": None if self.rig is None else self.rig.name,
            "frames": self.motion.num_frames,
            "fps": float(self.motion.fps),
            "noise_deg": dict(zip(names, torch.rad2deg(self.noise).tolist(), strict=True)),
            "noise_root_cm": 100 * self.noise_root,
            "faults": [vars(fault) for fault in self.faults],
            "correction_cm": dict(zip(names, moved.tolist(), strict=True)),
            "correction_deg": dict(zip(names, turned.tolist(), strict=True)),
            "contacts": self.list_contact_frames(),
            "fallback": self.find_fallbacks(),
            "densities": [vars(stretch) for stretch in self.stretches],
            "ledger": self.ledger.summary(),
            "seconds": self.seconds,
            "frame_ms": 1000 * self.seconds / self.motion.num_frames,
            "notes": list(self.notes),
        }

    def correction(self) -> tuple[Float[Tensor, " joints"], Float[Tensor, " joints"]]:
        """By joint of the rig the mean distance that it was moved by (cm), and the mean angle in its parent (deg)."""
        moved = (self.motion.joint_positions() - self.capture.joint_positions()).norm(dim=-1)
        turn = rotations.multiply(rotations.inverse(self.capture.local_quat_xyzw), self.motion.local_quat_xyzw)
        angle = torch.rad2deg(rotations.to_rotation_vector(turn).norm(dim=-1))
        return 100 * moved.mean(dim=0), angle.mean(dim=0)

    def list_contact_frames(self) -> dict[str, list[list[int]]]:
        """By foot, first frame and one past the last of each contact, in frames of the capture."""
        scale = float(self.motion.fps) / PRIOR_FPS
        found: dict[str, list[list[int]]] = {"left": [], "right": []}
        for foot, start, stop in true_intervals(self.contacts):
            found[("left", "right")[foot]].append([round(start * scale), self._last(stop, scale)])
        return found

    def _last(self, stop: int, scale: float) -> int:
        """One past the last frame of the capture, for one at the prior's rate."""
        return min(self.motion.num_frames, round(stop * scale))

    def find_fallbacks(self) -> list[dict[str, Any]]:
        """Joints, and frames of the capture, in which the network was out of its depth."""
        scale = float(self.motion.fps) / PRIOR_FPS
        return [
            {"joint": CANONICAL.names[joint], "start": round(start * scale), "stop": self._last(stop, scale)}
            for joint, start, stop in true_intervals(self.proposal_share < _FALLBACK_SHARE)
        ]


def join_segments(pieces: Sequence[tuple[DenoiseResult, int]]) -> DenoiseResult:
    """Pieces of one capture, each with the frame that it begins at; where two overlap the second fades in.

    By halves: one after the other each frame would be copied once for every piece.
    """
    if len(pieces) == 1:
        return pieces[0][0]
    middle = len(pieces) // 2
    return _append_segment(
        join_segments(pieces[:middle]), join_segments(pieces[middle:]), pieces[middle][1] - pieces[0][1]
    )


def _append_segment(whole: DenoiseResult, piece: DenoiseResult, start: int) -> DenoiseResult:
    """`piece` begins at frame `start` of `whole`."""
    shared = whole.motion.num_frames - start
    motion = crossfade(whole.motion, piece.motion, shared)
    ratio = PRIOR_FPS / float(motion.fps)
    skip = start + shared // 2
    kept = round(skip * ratio)
    skipped = kept - round(start * ratio)
    faults = _merge_faults(
        _clip_to_frames(whole.faults, 0, skip),
        _clip_to_frames(_shift_frames(piece.faults, start), skip, motion.num_frames),
    )
    later = _clip_to_frames(_shift_frames(piece.stretches, start), skip, motion.num_frames)
    share = piece.motion.num_frames / motion.num_frames
    return replace(
        whole,
        motion=motion,
        capture=whole.capture.join(piece.capture.slice(shared, piece.capture.num_frames)),
        noise=(1 - share) * whole.noise + share * piece.noise,
        noise_root=(1 - share) * whole.noise_root + share * piece.noise_root,
        faults=faults,
        contacts=torch.cat([whole.contacts[:kept], piece.contacts[skipped:]]),
        proposal_share=torch.cat([whole.proposal_share[:kept], piece.proposal_share[skipped:]]),
        ledger=whole.ledger.slice(kept).join(_slice_ledger(piece.ledger, slice(skipped, None))),
        seconds=whole.seconds + piece.seconds,
        notes=tuple(dict.fromkeys(whole.notes + piece.notes)),
        stretches=(*_clip_to_frames(whole.stretches, 0, skip), *later),
    )


def _shift_frames(parts: Sequence[Part], frames: int) -> list[Part]:
    """The same, so many frames later."""
    return [replace(part, start=part.start + frames, stop=part.stop + frames) for part in parts]


def _clip_to_frames(parts: Sequence[Part], start: int, stop: int) -> list[Part]:
    """What of the faults or stretches lies in frames start to stop."""
    cut = [replace(part, start=max(part.start, start), stop=min(part.stop, stop)) for part in parts]
    return [part for part in cut if part.start < part.stop]


def _merge_faults(before: Sequence[Artefact], after: Sequence[Artefact]) -> tuple[Artefact, ...]:
    """Both; what ends where the same goes on is one fault, as bad as the worse of the two."""
    ends = {(fault.joint, fault.kind, fault.unit, fault.stop): number for number, fault in enumerate(before)}
    chained = list(before)
    for fault in after:
        number = ends.get((fault.joint, fault.kind, fault.unit, fault.start))
        if number is None:
            chained.append(fault)
        else:
            first = chained[number]
            chained[number] = replace(first, stop=fault.stop, amount=max(first.amount, fault.amount))
    return tuple(chained)


def _slice_ledger(ledger: Ledger, frames: slice) -> Ledger:
    """Of some frames."""
    entries = (replace(e, energy=e.energy[frames], residual=e.residual[frames]) for e in ledger.entries)
    return Ledger(tuple(entries))


def crossfade(before: Motion, after: Motion, shared: int) -> Motion:
    """`before`, then `after`, which fades in over the last `shared` frames of the one and the first of the other."""
    if shared == 0:
        return before.join(after)
    first = before.num_frames - shared
    weight = torch.linspace(0, 1, shared, dtype=torch.float64)
    tail, head = before.slice(first, before.num_frames), after.slice(0, shared)
    place = torch.lerp(tail.root_position, head.root_position, weight[:, None])
    moving = {
        joint: torch.lerp(values, head.moving_offsets[joint], weight[:, None])
        for joint, values in tail.moving_offsets.items()
    }
    turns = weight[:, None].expand(shared, before.num_joints)
    quats = rotations.slerp(tail.local_quat_xyzw, head.local_quat_xyzw, turns)
    mixed = replace(tail, root_position=place, local_quat_xyzw=quats, moving_offsets=moving)
    parts = [mixed]
    if first > 0:
        parts.insert(0, before.slice(0, first))
    if shared < after.num_frames:
        parts.append(after.slice(shared, after.num_frames))
    return reduce(Motion.join, parts)
