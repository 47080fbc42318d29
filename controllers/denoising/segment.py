"""Denoising of one segment of a capture: proposal, residual motion, MAP stage, and retargeting to its rig."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import (
    RefinedMotion,
    RefinementSettings,
    anchor_to_contacts,
    estimate_rest_height,
    refine,
)
from controllers.denoising.result import DenoiseSolution
from mapctl import retarget, rotations
from mapctl.contacts import debounced
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.problem.density_selection import DensityInterval
from mapctl.problem.solution import Outcome, Status
from mapctl.protocols import Denoiser, Density
from mapctl.recording import Capture, artefacts
from mapctl.recording.frequency_bands import split_bands
from mapctl.recording.inspection import Inspection
from mapctl.recording.lasting_noise import LastingNoise, find_lasting_noise
from mapctl.recording.noise_estimation import estimate_angle_noise, estimate_position_noise
from mapctl.recording.quaternion_signs import choose_continuous_signs
from mapctl.recording.residual_motion import WHITE, restore_residual_motion
from mapctl.recording.spike_detection import LEAST_NOISE, find_residual_spikes
from mapctl.recording.sure_smoothing import smooth_rotations
from mapctl.retarget import RigMap, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, TOES, leg_length
from mapctl.terms import Term

_LASTING_ROUNDS = 4  # proposals that are asked for at most, each told of the noise that the one before has shown


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
        self.repaired = _smooth_noncanonical_joints(inspection, rig)
        canonical, self.rigmap = to_canonical(self.repaired, rig)
        canonical = replace(canonical, local_quat_xyzw=choose_continuous_signs(canonical.local_quat_xyzw))
        observed = _map_mask_to_canonical(inspection.known, self.rigmap)
        self.hidden_root = inspection.dropouts_root | ~_are_hip_ancestors_observed(~inspection.lost, self.rigmap)
        self.observed_root = inspection.seen_root & _are_hip_ancestors_observed(inspection.known, self.rigmap)
        self.sigma, self.sigma_root = self._estimate_noise(canonical, observed)
        self.bands = split_bands(canonical)
        if self.bands.exact:
            # Nothing is filtered: the network gets the raw frames, and a mask of those to ignore.
            raw = to_canonical(inspection.with_locked_joints(), rig)[0]
            self.bands = split_bands(_match_quaternion_signs(raw, canonical))
        self.shown = self.bands.at_prior_rate()
        self.capture = self._build_capture(observed)
        self.lasting: LastingNoise | None = None

    def run(self, densities: Sequence[Density], terms: Sequence[Term], first_frame: int) -> DenoiseSolution:
        """Propose, restore residual motion, refine, and retarget to the rig. The segment begins at frame `first_frame`
        of the whole capture, at PRIOR_FPS, which is the time that terms see.
        """
        proposal, contacts = self._propose()
        if self.bands.exact:
            self.capture = self._redetect_spikes(proposal)
            proposal, contacts = self._propose()
        proposal, contacts = self._propose_under_lasting_noise(proposal, contacts)
        proposal, share = self._restore_residual(proposal)
        if self.settings.anchor:
            proposal = anchor_to_contacts(proposal, debounced(contacts > 0))
        refined = refine(
            proposal,
            contacts,
            self.capture,
            self.settings.refinement,
            densities=densities,
            terms=terms,
            first_frame=first_frame,
        )
        joined = self.bands.recombine(self.shown, refined.motion, self.sigma, self.sigma_root)
        motion = retarget.from_canonical(joined, self.rigmap, self.repaired)
        within = self.bands.within
        refined = replace(refined, contacts=refined.contacts[:within], ledger=refined.ledger.slice(within))
        inspection, noise = self.inspection, self._estimate_whole_noise()
        found = self._collect_faults(motion, proposal.slice(0, within), refined, noise)
        return DenoiseSolution(
            motion,
            Status(Outcome.DONE),
            refined.ledger,
            refined.windows,
            capture=inspection.motion,
            noise=noise,
            noise_root=inspection.noise_root,
            faults=found,
            contacts=refined.contacts,
            proposal_share=1 - share[:within],
            density_intervals=self._convert_to_capture_rate(refined.density_intervals),
        )

    def _convert_to_capture_rate(self, parts: Sequence[DensityInterval]) -> tuple[DensityInterval, ...]:
        """Convert intervals to frames of the capture; the last ends with it."""
        frames, shown = self.inspection.motion.num_frames, self.shown.num_frames
        ratio = float(self.inspection.motion.fps) / float(self.shown.fps)
        moved = [
            replace(
                part,
                start=min(frames, round(part.start * ratio)),
                stop=frames if part.stop == shown else min(frames, round(part.stop * ratio)),
            )
            for part in parts
        ]
        return tuple(part for part in moved if part.start < part.stop)

    def _collect_faults(
        self, motion: Motion, proposal: Motion, refined: RefinedMotion, noise: Float[Tensor, " rigged"]
    ) -> tuple[artefacts.Artefact, ...]:
        """Collect the artefacts, on the rig; `proposal` is the motion before the MAP stage."""
        inspection, names = self.inspection, motion.skeleton.names
        rotation = rotations.multiply(rotations.inverse(inspection.motion.local_quat_xyzw), motion.local_quat_xyzw)
        angles = torch.rad2deg(rotations.to_rotation_vector(rotation).norm(dim=-1))
        travelling = names[inspection.travels]
        distances = 100 * (inspection.place(motion) - inspection.place(inspection.motion)).norm(dim=-1)
        found = artefacts.list_noise(
            names, noise, inspection.noise_root, travels=inspection.travels, frames=motion.num_frames
        )
        found += artefacts.list_spikes(names, self._map_spikes_to_rig(), angles, "deg")
        found += artefacts.list_spikes([travelling], self._find_root_spikes(), distances[:, None], "cm")
        found += artefacts.list_dropouts(names, inspection.dropouts)
        toes = proposal.skeleton.indices(TOES)
        feet = [self.rigmap.joint_of[toe] for toe in toes]
        known = [names[foot] if foot is not None else TOES[side] for side, foot in enumerate(feet)]
        ratio = float(motion.fps) / float(self.shown.fps)
        height = estimate_rest_height(proposal, refined.contacts)
        steps = artefacts.list_foot_artefacts(
            known, proposal.joint_positions()[:, toes], refined.contacts, rest_height=height, fps=float(self.shown.fps)
        )
        return (*found, *(replace(f, start=round(f.start * ratio), stop=round(f.stop * ratio)) for f in steps))

    def _map_spikes_to_rig(self) -> Bool[Tensor, "frames joints"]:
        """Return spikes by joint of the rig, as redetected beside the proposal where that was done."""
        spikes = self.inspection.spikes.clone()
        if self.bands.exact:
            detected = ~self.capture.seen[0]
            for canonical, joint in enumerate(self.rigmap.joint_of):
                if joint is not None:
                    spikes[:, joint] = detected[:, canonical] & ~self.inspection.dropouts[:, joint]
        return spikes

    def _find_root_spikes(self) -> Bool[Tensor, "frames 1"]:
        """Find frames in which the root position is a spike."""
        if not self.bands.exact:
            return self.inspection.spikes_root[:, None]
        return (~self.capture.seen_root[0] & ~self.hidden_root)[:, None]

    def _estimate_noise(self, canonical: Motion, observed: Tensor) -> tuple[Float[Tensor, " joints"], float]:
        """Estimate the noise of canonical joints' angles (radians) and the hips' position (metres), at the capture's
        rate.
        """
        settings = self.settings
        sigma = estimate_angle_noise(canonical.local_quat_xyzw, observed)
        if settings.sigma_deg is not None:
            # Joints that never move have no noise either: they are locked, or the rig has none there.
            sigma = torch.where(sigma > 0, math.radians(settings.sigma_deg), 0.0).to(sigma)
        root = estimate_position_noise(canonical.root_position, self.observed_root)
        return sigma, root if settings.sigma_cm is None else settings.sigma_cm / 100

    def _estimate_whole_noise(self) -> Float[Tensor, " rigged"]:
        """Estimate the noise of each of a joint's angles on the rig, radians, what lasts beyond a frame included."""
        noise = self.inspection.noise.clone()
        if self.lasting is not None:
            for canonical, joint in enumerate(self.rigmap.joint_of):
                if joint is not None and self.capture.sigma[0, canonical] > noise[joint] > 0:
                    noise[joint] = self.capture.sigma[0, canonical]
        return noise

    def _build_capture(self, observed: Tensor) -> Capture:
        """Build the network's input, at its own rate."""
        root = self.observed_root[:, None]
        sigma = self.bands.noise_at_prior_rate(self.sigma)
        sigma_root = self.bands.noise_at_prior_rate(torch.tensor(self.sigma_root))
        return Capture.of_motion(
            self.shown,
            seen=self._resample_mask(observed),
            seen_root=self._resample_mask(root)[:, 0],
            sigma=sigma,
            sigma_root=float(sigma_root),
        )

    def _resample_mask(self, observed: Bool[Tensor, "frames columns"]) -> Bool[Tensor, "shown columns"]:
        """Resample a mask to the prior's rate: observed where at least half of the frames around it are."""
        ratio = float(self.inspection.motion.fps) / float(self.shown.fps)
        side = max(0, round((ratio - 1) / 2))
        padded = torch.nn.functional.pad(observed.double().T[:, None], (side, side), mode="replicate")
        share = torch.nn.functional.avg_pool1d(padded, 2 * side + 1, stride=1)[:, 0].T
        at = (torch.arange(self.shown.num_frames) * ratio).round().long().clamp(max=len(observed) - 1)
        return share[at] >= 0.5

    def _propose(self) -> tuple[Motion, Float[Tensor, "frames 2"]]:
        """Return the network's motion on the performer's bones, and contact logits."""
        scale = leg_length(CANONICAL) / leg_length(self.rigmap.skeleton)
        unit_capture = replace(self.capture, root=self.capture.root * scale, sigma_root=self.capture.sigma_root * scale)
        cleaned = self.denoiser.clean(unit_capture)
        quats = rotations.make_sign_continuous(cleaned.pose.local_quat_xyzw[0].double())
        motion = Motion(self.rigmap.skeleton, self.shown.fps, cleaned.pose.root_position[0].double() / scale, quats)
        return motion, cleaned.contact_logits[0]

    def _redetect_spikes(self, proposal: Motion) -> Capture:
        """Detect spikes again in the residual beside the proposal: fast motion mistaken for one is observed again.

        A joint without noise shows its spikes by itself; what its residual has is motion that the proposal misses.
        """
        dropouts = ~_map_mask_to_canonical(~self.inspection.lost, self.rigmap)
        sigma = self.capture.sigma[0].double()
        spikes = find_residual_spikes(self._compute_residual_rotations(proposal), sigma)
        spikes &= (sigma > LEAST_NOISE) | ~self.capture.seen[0]
        root = (self.shown.root_position - proposal.root_position)[:, None]
        leap = find_residual_spikes(root, self.capture.sigma_root.double())[:, 0]
        return replace(self.capture, seen=~(dropouts | spikes)[None], seen_root=~(self.hidden_root | leap)[None])

    def _propose_under_lasting_noise(self, proposal: Motion, contacts: Tensor) -> tuple[Motion, Tensor]:
        """Propose anew where the residual shows noise that lasts, which is told from then on."""
        if self.settings.sigma_deg is not None:
            return proposal, contacts
        before, given = self.capture, (proposal, contacts)
        self.capture = self._estimate_at_prior_rate(before)
        if self.capture is not before:
            proposal, contacts = self._propose()
        for _ in range(_LASTING_ROUNDS):
            capture, rest = self.capture, self._compute_residual_rotations(proposal)
            found = find_lasting_noise(rest, capture.seen[0], capture.sigma[0].double(), again=self.lasting is not None)
            if found is None:
                break
            self.lasting, factor = found, found.factor.to(capture.sigma)
            usual = factor.median() if self.settings.sigma_cm is None else 1.0
            self.capture = replace(capture, sigma=factor * capture.sigma, sigma_root=usual * capture.sigma_root)
            proposal, contacts = self._propose()
        if self.lasting is None:
            self.capture = before
            return given
        return proposal, contacts

    def _estimate_at_prior_rate(self, capture: Capture) -> Capture:
        """Return the capture with the noise estimated at the prior's rate where that is more; itself where nothing is.

        At a higher rate noise that was filtered leaves nothing from frame to frame; at the prior's it leaves a little,
        which the network has to be told before the rest shows in a residual.
        """
        if self.bands.exact:
            return capture
        sigma = estimate_angle_noise(self.shown.local_quat_xyzw, capture.seen[0])[None].to(capture.sigma)
        if bool((sigma <= capture.sigma).all()):
            return capture
        root = capture.sigma_root
        if self.settings.sigma_cm is None:
            root = root.clamp(min=estimate_position_noise(self.shown.root_position, capture.seen_root[0]))
        return replace(capture, sigma=torch.maximum(capture.sigma, sigma), sigma_root=root)

    def _restore_residual(self, proposal: Motion) -> tuple[Motion, Float[Tensor, "frames joints"]]:
        """Return the proposal with its residual motion restored, and the restored share by frame and joint."""
        capture, correlation = self.capture, WHITE if self.lasting is None else self.lasting.correlation
        angles, share = restore_residual_motion(
            self._compute_residual_rotations(proposal), capture.seen[0], capture.sigma[0].double(), correlation
        )
        offset = (self.shown.root_position - proposal.root_position)[:, None]
        root, _ = restore_residual_motion(
            offset, capture.seen_root[0][:, None], capture.sigma_root.double(), correlation
        )
        quats = rotations.multiply(proposal.local_quat_xyzw, rotations.from_rotation_vector(angles))
        restored = replace(proposal, root_position=proposal.root_position + root[:, 0], local_quat_xyzw=quats)
        return restored, share

    def _compute_residual_rotations(self, proposal: Motion) -> Float[Tensor, "frames joints 3"]:
        """Compute the rotation vectors from the proposal to the capture, radians."""
        residual = rotations.multiply(rotations.inverse(proposal.local_quat_xyzw), self.shown.local_quat_xyzw)
        return rotations.to_rotation_vector(residual)


def _match_quaternion_signs(motion: Motion, other: Motion) -> Motion:
    """Give quaternions the signs of another motion's, so that unobserved frames flip no sign after them."""
    dots = (motion.local_quat_xyzw * other.local_quat_xyzw).sum(dim=-1, keepdim=True)
    return replace(motion, local_quat_xyzw=torch.where(dots < 0, -1.0, 1.0) * motion.local_quat_xyzw)


def _smooth_noncanonical_joints(inspection: Inspection, rig: Rig | None) -> Motion:
    """Return the repaired capture; joints without a canonical one, such as fingers, are smoothed by their noise."""
    motion = inspection.repaired()
    used = set(retarget.identify_rig(motion.skeleton, rig).joint_of)
    others = [j for j in range(motion.num_joints) if j not in used and inspection.noise[j] > 0]
    if not others:
        return motion
    quats = motion.local_quat_xyzw.clone()
    quats[:, others] = smooth_rotations(quats[:, others], inspection.noise[others])
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
