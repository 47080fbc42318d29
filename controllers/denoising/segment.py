"""Denoising of one segment of a capture: proposal, fusion with the capture, MAP stage, and retargeting to its rig."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import reduce
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import RefinedMotion, RefinementSettings, anchor_to_contacts, refine
from mapctl import retarget, rotations
from mapctl.contacts import debounced
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.density_selection import DensityInterval
from mapctl.problem.solution import Outcome, Solution, Status
from mapctl.protocols import Denoiser, Density
from mapctl.recording import Capture
from mapctl.recording.fusion import (
    fuse_positions,
    fuse_rotations,
    measure_kept_noise,
    smooth_columns,
    transfer_change,
    upsample,
)
from mapctl.recording.inspection import (
    Artefact,
    Inspection,
    list_dropouts,
    list_foot_artefacts,
    list_noise,
    list_spikes,
)
from mapctl.recording.noise_estimation import choose_continuous_signs, estimate_angle_noise, estimate_position_noise
from mapctl.retarget import RigMap, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, TOES, leg_length
from mapctl.terms import Term

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
    rig: Rig | None = None
    """The rig as it was identified."""
    density_intervals: tuple[DensityInterval, ...] = ()
    """Density and its weight in each window, in frames of the capture; empty where none was given."""

    def assess(self) -> "DenoiseSolution":
        """Return the solution whose status says whether the network was out of its depth in more than half of it."""
        out_of_depth = float(self.proposal_share.mean()) < _FALLBACK_SHARE and bool(self.noise.max() > 0)
        return replace(
            self, status=replace(self.status, outcome=Outcome.OUT_OF_DEPTH if out_of_depth else Outcome.DONE)
        )

    def slice(self, start: int, stop: int) -> "DenoiseSolution":
        """Return frames start to stop with their artefacts; the noise stays that of the whole."""
        ratio = PRIOR_FPS / float(self.motion.fps)
        part = slice(round(start * ratio), round(stop * ratio))
        faults = shift_frames(_clip_to_frames(self.faults, start, stop), -start)
        return replace(
            self,
            motion=self.motion.slice(start, stop),
            capture=self.capture.slice(start, stop),
            faults=tuple(faults),
            contacts=self.contacts[part],
            proposal_share=self.proposal_share[part],
            error=self.error[part],
            density_intervals=tuple(shift_frames(_clip_to_frames(self.density_intervals, start, stop), -start)),
            ledger=self.ledger.pick(part),
        )

    def details(self) -> dict[str, Any]:
        """Return noise, faults, corrections, contacts, fallbacks and densities, and compute of each frame."""
        names = self.motion.skeleton.names
        moved, turned = self.correction()
        return {
            "rig": None if self.rig is None else self.rig.name,
            "noise_deg": dict(zip(names, torch.rad2deg(self.noise).tolist(), strict=True)),
            "noise_root_cm": 100 * self.noise_root,
            "error_deg": dict(zip(CANONICAL.names, torch.rad2deg(self.error.mean(dim=0)).tolist(), strict=True)),
            "faults": [vars(fault) for fault in self.faults],
            "correction_cm": dict(zip(names, moved.tolist(), strict=True)),
            "correction_deg": dict(zip(names, turned.tolist(), strict=True)),
            "contacts": self.list_contact_frames(),
            "fallback": self.find_fallbacks(),
            "densities": [vars(part) for part in self.density_intervals],
            "frame_ms": self.frame_ms,
        }

    @property
    def frame_ms(self) -> float:
        """Compute of each frame, milliseconds."""
        return 1000 * self.seconds / self.motion.num_frames

    def correction(self) -> tuple[Float[Tensor, " joints"], Float[Tensor, " joints"]]:
        """Compute by joint of the rig the mean distance it was moved by, cm, and the mean angle in its parent, deg."""
        moved = (self.motion.joint_positions() - self.capture.joint_positions()).norm(dim=-1)
        rotation = rotations.multiply(rotations.inverse(self.capture.local_quat_xyzw), self.motion.local_quat_xyzw)
        angle = torch.rad2deg(rotations.to_rotation_vector(rotation).norm(dim=-1))
        return 100 * moved.mean(dim=0), angle.mean(dim=0)

    def find_largest_move(self) -> tuple[str, int, float]:
        """Find the joint of the rig and the frame that were moved most, and by how many centimetres."""
        moved = 100 * (self.motion.joint_positions() - self.capture.joint_positions()).norm(dim=-1)
        frame, joint = divmod(int(moved.argmax()), moved.shape[1])
        return self.motion.skeleton.names[joint], frame, float(moved[frame, joint])

    def list_contact_frames(self) -> dict[str, list[list[int]]]:
        """List by foot the first frame and one past the last of each contact, in frames of the capture."""
        scale = float(self.motion.fps) / PRIOR_FPS
        found: dict[str, list[list[int]]] = {"left": [], "right": []}
        for foot, start, stop in true_intervals(self.contacts):
            found[("left", "right")[foot]].append([round(start * scale), self._last(stop, scale)])
        return found

    def _last(self, stop: int, scale: float) -> int:
        """Convert one past the last frame at PRIOR_FPS to frames of the capture."""
        return min(self.motion.num_frames, round(stop * scale))

    def find_fallbacks(self) -> list[dict[str, Any]]:
        """List joints, and frames of the capture, in which the network was out of its depth."""
        scale = float(self.motion.fps) / PRIOR_FPS
        return [
            {"joint": CANONICAL.names[joint], "start": round(start * scale), "stop": self._last(stop, scale)}
            for joint, start, stop in true_intervals(self.proposal_share < _FALLBACK_SHARE)
        ]


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
    ratio = PRIOR_FPS / float(motion.fps)
    skip = start + shared // 2
    kept = round(skip * ratio)
    skipped = kept - round(start * ratio)
    faults = _merge_faults(
        _clip_to_frames(whole.faults, 0, skip),
        _clip_to_frames(shift_frames(piece.faults, start), skip, motion.num_frames),
    )
    later = _clip_to_frames(shift_frames(piece.density_intervals, start), skip, motion.num_frames)
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
        error=torch.cat([whole.error[:kept], piece.error[skipped:]]),
        ledger=whole.ledger.slice(kept).join(piece.ledger.pick(slice(skipped, None))),
        seconds=whole.seconds + piece.seconds,
        windows=whole.windows + piece.windows,
        status=replace(whole.status, notes=tuple(dict.fromkeys(whole.notes + piece.notes))),
        density_intervals=(*_clip_to_frames(whole.density_intervals, 0, skip), *later),
    )


def shift_frames(parts: Sequence[Part], frames: int) -> list[Part]:
    """Shift parts by so many frames."""
    return [replace(part, start=part.start + frames, stop=part.stop + frames) for part in parts]


def _clip_to_frames(parts: Sequence[Part], start: int, stop: int) -> list[Part]:
    """Clip parts to frames start to stop."""
    cut = [replace(part, start=max(part.start, start), stop=min(part.stop, stop)) for part in parts]
    return [part for part in cut if part.start < part.stop]


def _merge_faults(before: Sequence[Artefact], after: Sequence[Artefact]) -> tuple[Artefact, ...]:
    """Merge faults; what ends where the same goes on is one fault, as bad as the worse of the two."""
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


def crossfade(before: Motion, after: Motion, shared: int) -> Motion:
    """Join two motions; the second fades in over `shared` frames, the last of the first and the first of its own."""
    if shared == 0:
        return before.join(after)
    first = before.num_frames - shared
    weight = torch.linspace(0, 1, shared, dtype=torch.float64)
    tail, head = before.slice(first, before.num_frames), after.slice(0, shared)
    root = torch.lerp(tail.root_position, head.root_position, weight[:, None])
    moving = {
        joint: torch.lerp(values, head.moving_offsets[joint], weight[:, None])
        for joint, values in tail.moving_offsets.items()
    }
    weights = weight[:, None].expand(shared, before.num_joints)
    quats = rotations.slerp(tail.local_quat_xyzw, head.local_quat_xyzw, weights)
    mixed = replace(tail, root_position=root, local_quat_xyzw=quats, moving_offsets=moving)
    parts = [before.slice(0, first)] if first > 0 else []
    parts += [mixed, after.slice(shared, after.num_frames)] if shared < after.num_frames else [mixed]
    return reduce(Motion.join, parts)


_LOW_PASS = 0.4  # of the rate of the frames that the denoiser sees: what is faster would be folded into them


@dataclass(frozen=True)
class DenoiseSettings:
    """Noise of the capture, and settings of the search."""

    sigma_deg: float | None = None
    """Noise of each of a joint's angles, degrees; estimated from the capture, joint by joint, if None."""
    sigma_cm: float | None = None
    """Noise of each coordinate of the hips, centimetres; estimated from the capture if None."""
    anchor: bool = False
    """Whether the trajectory is corrected so that planted feet do not travel, for captures that drift."""
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    """Settings of the MAP stage."""

    def __post_init__(self):
        for name in ("sigma_deg", "sigma_cm"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 100:
                raise RequestError(f"{name} must lie between 0 and 100, got {value:g}")


class SegmentDenoiser:
    """Denoiser of one inspected segment."""

    def __init__(self, inspection: Inspection, denoiser: Denoiser, settings: DenoiseSettings, rig: Rig | None = None):
        self.inspection, self.denoiser, self.settings = inspection, denoiser, settings
        self.fps = float(inspection.motion.fps)
        self.repaired = _smooth_noncanonical_joints(inspection, rig)
        canonical, self.rigmap = to_canonical(self.repaired, rig)
        self.canonical = replace(canonical, local_quat_xyzw=choose_continuous_signs(canonical.local_quat_xyzw))
        self.seen = _map_mask_to_canonical(inspection.known, self.rigmap)
        self.seen_root = inspection.seen_root & _are_hip_ancestors_observed(inspection.known, self.rigmap)
        self.sigma, self.sigma_root = self._estimate_noise()

    def run(self, densities: Sequence[Density], terms: Sequence[Term], first_frame: int) -> DenoiseSolution:
        """Propose, fuse with the capture, refine, and retarget to the rig. The segment begins at frame `first_frame`
        of the whole capture, at PRIOR_FPS, which is the time that terms see.
        """
        proposal, contacts, spread = self._propose()
        fused, share, error = self._fuse(proposal)
        error = torch.where(self.seen, error, spread)  # where nothing was observed, the model's own estimate
        shown = fused.resample(PRIOR_FPS)
        at = (torch.arange(shown.num_frames) * self.fps / PRIOR_FPS).round().long().clamp(max=fused.num_frames - 1)
        contacts = contacts[at]
        start = anchor_to_contacts(shown, debounced(contacts > 0)) if self.settings.anchor else shown
        refined = refine(
            start,
            contacts,
            Capture.of_motion(
                shown, seen=self.seen[at], seen_root=self.seen_root[at], sigma=self.sigma, sigma_root=self.sigma_root
            ),
            self.settings.refinement,
            densities=densities,
            terms=terms,
            first_frame=first_frame,
        )
        seconds = torch.arange(shown.num_frames, dtype=torch.float64) / PRIOR_FPS
        changed = transfer_change(fused, shown, refined.motion, seconds)
        motion = retarget.from_canonical(changed, self.rigmap, self.repaired)
        inspection = self.inspection
        return DenoiseSolution(
            motion,
            Status(Outcome.DONE),
            refined.ledger,
            refined.windows,
            capture=inspection.motion,
            noise=inspection.noise,
            noise_root=inspection.noise_root,
            faults=self._collect_faults(motion, shown, refined),
            contacts=refined.contacts,
            proposal_share=share[at],
            error=error[at],
            density_intervals=self._convert_to_capture_rate(refined.density_intervals, shown.num_frames),
        )

    def _convert_to_capture_rate(self, parts: Sequence[DensityInterval], shown: int) -> tuple[DensityInterval, ...]:
        """Convert intervals of `shown` frames at PRIOR_FPS to frames of the capture; the last ends with it."""
        frames, ratio = self.inspection.motion.num_frames, self.fps / PRIOR_FPS
        moved = [
            replace(
                part,
                start=min(frames, round(part.start * ratio)),
                stop=frames if part.stop == shown else min(frames, round(part.stop * ratio)),
            )
            for part in parts
        ]
        return tuple(part for part in moved if part.start < part.stop)

    def _collect_faults(self, motion: Motion, shown: Motion, refined: RefinedMotion) -> tuple[Artefact, ...]:
        """Collect the artefacts, on the rig; `shown` is the motion before the MAP stage."""
        inspection, names = self.inspection, motion.skeleton.names
        rotation = rotations.multiply(rotations.inverse(inspection.motion.local_quat_xyzw), motion.local_quat_xyzw)
        angles = torch.rad2deg(rotations.to_rotation_vector(rotation).norm(dim=-1))
        travelling = names[inspection.travels]
        distances = 100 * (inspection.place(motion) - inspection.place(inspection.motion)).norm(dim=-1)
        found = list_noise(
            names, inspection.noise, inspection.noise_root, travels=inspection.travels, frames=motion.num_frames
        )
        found += list_spikes(names, inspection.spikes, angles, "deg")
        found += list_spikes([travelling], inspection.spikes_root[:, None], distances[:, None], "cm")
        found += inspection.faults
        found += list_dropouts(names, inspection.dropouts & ~inspection.frozen[:, None])
        toes = shown.skeleton.indices(TOES)
        feet = [self.rigmap.joint_of[toe] for toe in toes]
        known = [names[foot] if foot is not None else TOES[side] for side, foot in enumerate(feet)]
        steps = list_foot_artefacts(
            known, shown.joint_positions()[:, toes], refined.contacts, rest_height=refined.supports, fps=PRIOR_FPS
        )
        ratio = self.fps / PRIOR_FPS
        return (*found, *(replace(f, start=round(f.start * ratio), stop=round(f.stop * ratio)) for f in steps))

    def _estimate_noise(self) -> tuple[Float[Tensor, " joints"], float]:
        """Estimate the noise of canonical joints' angles (radians) and the hips' position (metres)."""
        settings = self.settings
        sigma = estimate_angle_noise(self.canonical.local_quat_xyzw, self.seen)
        if settings.sigma_deg is not None:
            # Joints that never move have no noise either: they are locked, or the rig has none there.
            sigma = torch.where(sigma > 0, math.radians(settings.sigma_deg), 0.0).to(sigma)
        root = estimate_position_noise(self.canonical.root_position, self.seen_root)
        return sigma, root if settings.sigma_cm is None else settings.sigma_cm / 100

    def _propose(self) -> tuple[Motion, Float[Tensor, "frames 2"], Float[Tensor, "frames joints"]]:
        """Propose the motion on the performer's bones, contact logits, and the expected error of each of a joint's
        angles, radians, at the capture's rate.

        The denoiser sees every nth frame of the capture without what is too fast for that, or at low rates its frames
        with unobserved ones between them, so that no noise is interpolated: whole steps that come nearest to PRIOR_FPS.
        """
        scale = leg_length(CANONICAL) / leg_length(self.rigmap.skeleton)
        step, between = max(1, round(self.fps / PRIOR_FPS)), max(1, round(PRIOR_FPS / self.fps))
        quats, root = self.canonical.local_quat_xyzw, self.canonical.root_position
        seen, seen_root, kept = self.seen, self.seen_root, 1.0
        if step > 1:
            hertz = _LOW_PASS * self.fps / step
            quats = smooth_columns(quats, seen.double(), hertz, self.fps)
            quats = torch.nn.functional.normalize(quats, dim=-1)
            root = smooth_columns(root[:, None], seen_root.double()[:, None], hertz, self.fps)[:, 0]
            kept = measure_kept_noise(hertz, self.fps)
        last = self.canonical.num_frames - 1
        frames = torch.arange(0, last + step, step).repeat_interleave(between).clamp(max=last)
        observed = (torch.arange(len(frames)) % between == 0)[:, None]
        thin = Motion(self.canonical.skeleton, Fraction(PRIOR_FPS), scale * root[frames], quats[frames])
        capture = Capture.of_motion(
            thin,
            seen=seen[frames] & observed,
            seen_root=seen_root[frames] & observed[:, 0],
            sigma=kept**0.5 * self.sigma,
            sigma_root=kept**0.5 * scale * self.sigma_root,
        )
        cleaned = self.denoiser.clean(capture)
        seconds = torch.arange(len(frames), dtype=torch.float64) * step / between / self.fps

        def follow(values: Tensor) -> Tensor:
            if step == 1:
                return values[::between]
            return upsample(values, seconds, fps=self.fps, frames=last + 1)

        quats = follow(rotations.make_sign_continuous(cleaned.pose.local_quat_xyzw[0].double()))
        quats = torch.nn.functional.normalize(quats, dim=-1)
        root = follow(cleaned.pose.root_position[0].double()) / scale
        motion = Motion(self.rigmap.skeleton, self.canonical.fps, root, quats)
        return motion, follow(cleaned.contact_logits[0]), follow(cleaned.log_spread[0, :, 1:].double()).exp()

    def _fuse(self, proposal: Motion) -> tuple[Motion, Float[Tensor, "frames joints"], Float[Tensor, "frames joints"]]:
        """Fuse the proposal with the capture; also the share of the proposal, and the error, radians, that remains."""
        turned = fuse_rotations(
            proposal.local_quat_xyzw, self.canonical.local_quat_xyzw, self.seen, self.sigma, self.fps
        )
        moved = fuse_positions(
            proposal.root_position, self.canonical.root_position, self.seen_root, self.sigma_root, self.fps
        )
        quats = rotations.make_sign_continuous(turned.values)
        fused = replace(proposal, root_position=moved.values[:, 0], local_quat_xyzw=quats)
        return fused, turned.share, turned.error


def _smooth_noncanonical_joints(inspection: Inspection, rig: Rig | None) -> Motion:
    """Return the repaired capture; joints without a canonical one, such as fingers, are smoothed by their noise."""
    motion = inspection.repaired()
    used = set(retarget.identify_rig(motion.skeleton, rig).joint_of)
    others = [j for j in range(motion.num_joints) if j not in used and inspection.noise[j] > 0]
    if not others:
        return motion
    quats = motion.local_quat_xyzw.clone()
    sigma, seen = inspection.noise[others], inspection.seen[:, others]
    quats[:, others] = fuse_rotations(None, quats[:, others], seen, sigma, float(motion.fps)).values
    return replace(motion, local_quat_xyzw=quats)


def _map_mask_to_canonical(observed: Bool[Tensor, "frames rigged"], rigmap: RigMap) -> Bool[Tensor, "frames joints"]:
    """Map a mask: a canonical joint is observed if its rig joint is, and all between it and the canonical parent."""
    parents = rigmap.rig_skeleton.parents
    columns = []
    for canonical, joint in enumerate(rigmap.joint_of):
        above = rigmap.joint_of[CANONICAL.parents[canonical]] if canonical else None
        column = torch.ones(len(observed), dtype=torch.bool)
        while joint is not None and joint >= 0 and joint != above:
            column = column & observed[:, joint]
            joint = parents[joint]
        columns.append(column)
    return torch.stack(columns, dim=1)


def _are_hip_ancestors_observed(observed: Bool[Tensor, "frames rigged"], rigmap: RigMap) -> Bool[Tensor, " frames"]:
    """Return whether all ancestors of the hips were observed, which determine their position."""
    column, joint = torch.ones(len(observed), dtype=torch.bool), rigmap.joint_of[0]
    while joint is not None and (joint := rigmap.rig_skeleton.parents[joint]) >= 0:
        column = column & observed[:, joint]
    return column
