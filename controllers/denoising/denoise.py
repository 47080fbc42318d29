"""Denoise a capture on any rig (Wang et al. 2019, section 5.4).

1. Inspection (`mapctl.recording.inspection`): noise, spikes, drop-outs, held frames, bones that vary only by noise.
2. Proposal: a network that was trained on all kinds of motion sees the capture on canonical joints at PRIOR_FPS; an
   in-betweener proposes what is lost for longer.
3. Evidence test (`mapctl.recording.fusion`): the proposal is fused with the capture by the noise that the capture
   itself shows, so that on unfamiliar motion the result is a filter of the capture.
4. Trajectory (`controllers.denoising.trajectory`): where hips drift about standing toes, as in estimates from video,
   these correct it.
5. Refinement (`controllers.common.map_refinement`): the MAP problem about the fused motion plants the feet.
6. Result: on the capture's own rig, at its own rate, with all of its frames; the input where it would become rougher.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, refine
from controllers.denoising.only_faults import keep_all_but_faults
from controllers.denoising.solution import DenoiseSolution, join_segments, move_frames
from controllers.denoising.trajectory import correct_trajectory
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.ground import Ground
from mapctl.inbetweening import GapQuery
from mapctl.metrics.faults import list_inspected_faults
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.problem.solution import Ledger, Outcome, Status
from mapctl.problem.unknowns import SMOOTH_FRAMES
from mapctl.protocols import Denoiser, Density, Inbetweener
from mapctl.recording import Capture, CaptureProposal
from mapctl.recording.fusion import (
    fuse_positions,
    fuse_rotations,
    measure_kept_noise,
    smooth_columns,
    transfer_change,
    upsample,
)
from mapctl.recording.inspection import MIN_FRAMES, Inspection, correct_structure, inspect_recording
from mapctl.recording.masks import (
    Mask,
    MissingMask,
    expand_valid_masks,
    resolve_joint_names,
    restore_observed,
    slice_masks,
    write_back_masked,
)
from mapctl.recording.noise_estimation import choose_continuous_signs, estimate_angle_noise, estimate_position_noise
from mapctl.retarget import RigMap, as_rig, from_canonical, identify_rig, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, leg_length
from mapctl.terms import Term

_SEGMENT_SECONDS = 60.0  # seconds of a long capture that are cleaned at once
_OVERLAP_SECONDS = 2.0  # seconds that two segments share
_LEAD_SIGMAS = 3.0  # noise of an angle within which a joint of a lead pose may differ from what is expected


CaptureKind: TypeAlias = Literal["auto", "studio", "video"]


@dataclass(frozen=True)
class DenoiseSettings:
    """Noise of the capture, and settings of the search."""

    sigma_deg: float | None = None
    """Noise of each of a joint's angles, degrees; estimated from the capture, joint by joint, if None."""
    sigma_cm: float | None = None
    """Noise of each coordinate of the hips, centimetres; estimated from the capture if None."""
    capture: CaptureKind = "auto"
    """Whether the trajectory is as good as the pose (`studio`), or drifts and floats as in estimates from `video`: then
    standing toes correct it. `auto` decides by how fast those slide in the first segment; a causal run leaves it."""
    ground: Ground | None = None
    """What feet of a capture from video stand on, where it is not the floor at y = 0."""
    only_faults: bool = False
    """Whether all stays to the bit but the frames and joints of faults, and legs and hips by a foot at fault."""
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    """Settings of the MAP stage."""

    def __post_init__(self):
        for name in ("sigma_deg", "sigma_cm"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 100:
                raise RequestError(f"{name} must lie between 0 and 100, got {value:g}")
        if self.only_faults and self.capture == "video":
            raise RequestError("only faults are repaired, but a capture from video moves as a whole; leave one out")


def denoise(
    motion: Motion,
    denoiser: Denoiser,
    *,
    inbetweener: Inbetweener | None = None,
    masks: Sequence[Mask] = (),
    settings: DenoiseSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DenoiseSolution:
    """Denoise a motion on any rig that `mapctl.retarget.rigs` identifies, or on a given one; RequestError for others
    and for masks that do not fit.

    `denoiser` proposes (see priors.load_denoiser), and `inbetweener`, if there is one, what is lost for longer (see
    LostPartFiller). Of `densities` the likeliest adds its likelihood to each window of the MAP stage; `terms` are the
    caller's own, which see the time since the capture's first frame. A T-pose before the motion, as many captures begin
    with, and the frames blended with it stay but for noise. A long capture is cleaned in segments that crossfade, so
    memory beyond the capture's own does not grow with it. `progress` is called with frames done and all frames.
    """
    settings, capture = settings or DenoiseSettings(), motion
    if settings.only_faults:
        settings = replace(settings, capture="studio")
    denoiser = denoiser if inbetweener is None else LostPartFiller(denoiser, inbetweener)
    masks = resolve_joint_names(motion, masks, rig)
    hidden = expand_valid_masks(motion, masks).joints  # checked whole: for a segment they are cut to its frames
    motion, rigmap, shares, faults = correct_structure(motion, rig, hidden)
    rig, lead = as_rig(rigmap), len(shares)
    frames, fps = motion.num_frames - lead, float(motion.fps)
    long, shared = (max(MIN_FRAMES, round(seconds * fps)) for seconds in (_SEGMENT_SECONDS, _OVERLAP_SECONDS))
    pieces: list[tuple[DenoiseSolution, int]] = []
    start = stop = 0
    while stop < frames:
        before, stop = stop, frames if frames - start <= long + shared else start + long
        part, part_masks = motion.slice(lead + start, lead + stop), slice_masks(masks, lead + start, lead + stop)
        if pieces:  # missing joints are known only from the segment before
            last, first = pieces[-1]
            part = write_back_masked(part, last.motion.slice(start - first, before - first), part_masks)
            part_masks = slice_masks(masks, lead + start, lead + stop, since=lead + before)
        first_frame = round((lead + start) / fps * PRIOR_FPS)
        done = _denoise_segment(part, denoiser, part_masks, settings, densities, terms, rig, first_frame)
        pieces.append((done, start))
        settings = replace(settings, capture="studio" if done.drift is None else "video")  # all segments alike
        start = stop - shared
        if progress is not None:
            progress(lead + stop, motion.num_frames)
    done = join_segments(pieces)
    notes = list(done.notes)
    if lead:
        done = _prepend_lead(motion.slice(0, lead), done, shares, rigmap)
        notes.insert(0, f"the T-pose in frame 0 stays but for noise, and so do frames blended with it: 0 to {lead - 1}")
    if swapped := sum(fault.kind == "swap" for fault in faults):
        notes.insert(0, f"left and right limbs are swapped {swapped} times: they are exchanged back")
    if stretched := len(faults) - swapped:
        notes.insert(0, f"offsets of {stretched} bones vary only by noise: they are held at their medians")
    status = replace(done.status, notes=tuple(notes))
    done = replace(done, capture=capture, rig=rig, faults=(*faults, *done.faults), status=status)
    return keep_all_but_faults(done, motion) if settings.only_faults else done.assess()


def _prepend_lead(
    lead: Motion, done: DenoiseSolution, shares: Float[Tensor, " lead"], rigmap: RigMap
) -> DenoiseSolution:
    """Put the lead pose before a clean motion; what is known by frame is there as in the first one after it. Frame 0 is
    shrunk towards the rest pose, and frames blended with it towards the arc from there to the motion, as far as the
    noise explains what lies between."""
    frames, count = lead.num_frames, round(lead.num_frames * PRIOR_FPS / float(lead.fps))
    captured, tpose = lead.local_quat_xyzw, torch.zeros(1, CANONICAL.num_joints, 4, dtype=torch.float64)
    tpose[..., 3] = 1
    at_rest = from_canonical(Motion(rigmap.skeleton, lead.fps, lead.root_position[:1], tpose), rigmap).local_quat_xyzw
    zero = torch.zeros_like(at_rest).index_fill(-1, torch.tensor(3), 1.0)
    apart = [float(rotations.turns_between(quats, captured[:1]).norm(dim=-1).mean()) for quats in (zero, at_rest)]
    first = _shrink(zero if apart[0] <= apart[1] else at_rest, captured[:1], done.noise)
    whole = rotations.turns_between(first, done.motion.local_quat_xyzw[:1])
    arc = rotations.multiply(first, rotations.from_rotation_vector(shares[1:, None, None].to(whole) * whole))
    clean = torch.cat([first, _shrink(arc, captured[1:], done.noise)])
    return replace(
        done,
        motion=replace(lead, local_quat_xyzw=clean).join(done.motion),
        faults=move_frames(done.faults, frames),
        density_intervals=move_frames(done.density_intervals, frames),
        **{name: torch.cat([values[:1].expand(count, -1), values]) for name, values in done.by_frame.items()},
    )


def _shrink(expected: Tensor, captured: Tensor, noise: Float[Tensor, " joints"]) -> Float[Tensor, "frames joints 4"]:
    """Shrink captured rotations towards expected ones by the share of their squared distance that is noise."""
    turns = rotations.turns_between(expected, captured)
    power = turns.square().sum(dim=-1, keepdim=True).clamp_min(1e-12)
    kept = (1 - (_LEAD_SIGMAS * noise[:, None]).square() / power).clamp_min(0)
    return rotations.multiply(expected, rotations.from_rotation_vector(kept * turns))


def _denoise_segment(
    motion: Motion,
    denoiser: Denoiser,
    masks: Sequence[Mask],
    settings: DenoiseSettings,
    densities: Sequence[Density],
    terms: Sequence[Term],
    rig: Rig,
    first_frame: int,
) -> DenoiseSolution:
    """Denoise a segment that begins at frame `first_frame` of the capture, at PRIOR_FPS, the time that terms see."""
    began, inspection = time.perf_counter(), inspect_recording(motion, masks)
    if motion.num_frames < MIN_FRAMES:
        note = f"{motion.num_frames} frames are too few to tell noise from motion: nothing was changed"
        nothing = torch.zeros(motion.num_frames, CANONICAL.num_joints)
        return DenoiseSolution(
            motion,
            Status(Outcome.DONE, (note,)),
            Ledger(),
            capture=motion,
            noise=inspection.noise,
            noise_root=inspection.noise_root,
            faults=(),
            contacts=nothing[:, :2] > 0,
            proposal_share=nothing,
            error=nothing,
        )
    observation = _Observation.of(inspection, settings, rig)
    proposal, contacts, spread = _propose(observation, denoiser)
    fused, share, error = _fuse(observation, proposal)
    from_video = settings.capture == "video" or (settings.capture == "auto" and _drifts(fused, error, settings.ground))
    if from_video:
        observation = observation.with_noise(settings, slow=True)
        fused, share, error = _fuse(observation.completed(proposal), None)
    error = torch.where(observation.seen, error, spread)  # where nothing was observed, the model's own estimate
    shown = fused.resample(PRIOR_FPS)
    fps, last = float(motion.fps), motion.num_frames - 1
    at = (torch.arange(shown.num_frames) * fps / PRIOR_FPS).round().long().clamp(max=last)
    contacts = contacts[at]
    found = correct_trajectory(shown, ground=settings.ground) if from_video else None
    refined = refine(
        shown if found is None else found.motion,
        contacts,
        observation.capture(shown, at),
        settings.refinement,
        densities=densities,
        terms=terms,
        first_frame=first_frame,
    )
    seconds = torch.arange(shown.num_frames, dtype=torch.float64) / PRIOR_FPS
    changed = transfer_change(fused, shown, refined.motion, seconds)
    clean, notes = from_canonical(changed, observation.rigmap, observation.repaired), ()
    if found is not None and settings.capture == "auto":
        notes = (
            f"standing toes slide at {100 * found.drift:.0f} cm/s, as in estimates from video: hips are moved so that"
            f" they are still, on the {'floor at y = 0' if settings.ground is None else 'ground'};"
            " --capture studio leaves them",
        )
    whole = bool(inspection.known.all() and inspection.seen_root.all()) and not terms and found is None
    if whole and _measure_roughness(clean) > _measure_roughness(motion):
        start = first_frame / PRIOR_FPS
        clean = motion
        notes = (f"frames from {start:.1f} s on would become rougher than they are: they were not changed",)
    return DenoiseSolution(
        clean,
        Status(Outcome.DONE, notes),
        refined.ledger,
        refined.windows,
        seconds=time.perf_counter() - began,
        capture=motion,
        noise=inspection.noise,
        noise_root=inspection.noise_root,
        faults=tuple(list_inspected_faults(inspection, rig)),
        contacts=refined.contacts,
        proposal_share=share[at],
        error=error[at],
        density_intervals=refined.density_intervals(motion),
        drift=None if found is None else found.drift,
    )


def _measure_roughness(motion: Motion) -> float:
    """Measure the mean third difference of joints' positions, metres: what noise adds most to."""
    return float(motion.joint_positions().diff(n=3, dim=0).norm(dim=-1).mean())


@dataclass(frozen=True, eq=False)
class _Observation:
    """An inspected recording on canonical joints, at its own rate and on the performer's bones."""

    repaired: Motion
    """The recording on its rig, faults filled in."""
    rigmap: RigMap
    canonical: Motion
    seen: Bool[Tensor, "frames joints"]
    seen_root: Bool[Tensor, " frames"]
    sigma: Float[Tensor, " joints"]
    """Noise of canonical joints' angles, radians."""
    sigma_root: float
    """Noise of the hips' position, metres."""
    noise_rate: float
    """Samples a second up to which that noise is white."""

    @staticmethod
    def of(inspection: Inspection, settings: DenoiseSettings, rig: Rig) -> "_Observation":
        """Put an inspected recording on canonical joints, and estimate its noise there."""
        repaired = _smooth_noncanonical_joints(inspection, rig)
        canonical, rigmap = to_canonical(repaired, rig)
        canonical = replace(canonical, local_quat_xyzw=choose_continuous_signs(canonical.local_quat_xyzw))
        seen, above_hips = _map_to_canonical(inspection.known, rigmap)
        seen_root = inspection.seen_root & above_hips
        silent = torch.zeros(CANONICAL.num_joints)
        return _Observation(repaired, rigmap, canonical, seen, seen_root, silent, 0.0, math.inf).with_noise(settings)

    def with_noise(self, settings: DenoiseSettings, *, slow: bool = False) -> "_Observation":
        """Estimate the noise as far as the settings do not give it: of every frame, or what is slow as from video."""
        step = max(1, round(float(self.canonical.fps) / _VIDEO_NOISE_RATE)) if slow else 1
        sigma = estimate_angle_noise(self.canonical.local_quat_xyzw[::step], self.seen[::step])
        if settings.sigma_deg is not None:
            # Joints that never move have no noise either: they are locked, or the rig has none there.
            sigma = torch.where(sigma > 0, math.radians(settings.sigma_deg), 0.0).to(sigma)
        root = estimate_position_noise(self.canonical.root_position[::step], self.seen_root[::step])
        sigma_root = root if settings.sigma_cm is None else settings.sigma_cm / 100
        rate = float(self.canonical.fps) / step
        return replace(self, sigma=sigma, sigma_root=sigma_root, noise_rate=rate)

    def completed(self, proposal: Motion) -> "_Observation":
        """Fill in what was not observed by the proposal: of noise slower than the frames the denoiser keeps more than
        a smoother of what was observed."""
        quats = torch.where(self.seen[..., None], self.canonical.local_quat_xyzw, proposal.local_quat_xyzw)
        root = torch.where(self.seen_root[:, None], self.canonical.root_position, proposal.root_position)
        canonical = replace(self.canonical, root_position=root, local_quat_xyzw=quats)
        return replace(
            self, canonical=canonical, seen=torch.ones_like(self.seen), seen_root=torch.ones_like(self.seen_root)
        )

    def capture(
        self, motion: Motion, at: Tensor, shown: Tensor | bool = True, *, kept: float = 1.0, scale: float = 1.0
    ) -> Capture:
        """Return a motion of frames `at` as a capture that is observed where `shown`, with a share `kept` of the
        noise's power, lengths times `scale`."""
        return Capture.of_motion(
            motion,
            seen=self.seen[at] & torch.as_tensor(shown)[..., None],
            seen_root=self.seen_root[at] & shown,
            sigma=kept**0.5 * self.sigma,
            sigma_root=kept**0.5 * scale * self.sigma_root,
        )


def _smooth_noncanonical_joints(inspection: Inspection, rig: Rig) -> Motion:
    """Return the repaired capture; joints without a canonical one, such as fingers, are smoothed by their noise."""
    motion = inspection.repaired()
    used = set(identify_rig(motion.skeleton, rig).joint_of)
    others = [j for j in range(motion.num_joints) if j not in used and inspection.noise[j] > 0]
    if not others:
        return motion
    quats = motion.local_quat_xyzw.clone()
    sigma, seen = inspection.noise[others], inspection.seen[:, others]
    quats[:, others] = fuse_rotations(None, quats[:, others], seen, sigma, float(motion.fps)).values
    return replace(motion, local_quat_xyzw=quats)


def _map_to_canonical(
    observed: Bool[Tensor, "frames rigged"], rigmap: RigMap
) -> tuple[Bool[Tensor, "frames joints"], Bool[Tensor, " frames"]]:
    """Map a mask: a canonical joint is observed if its rig joint is, and all between it and the canonical parent. Also
    return where all ancestors of the hips were observed, which determine their position."""
    parents = rigmap.rig_skeleton.parents

    def are_observed(joint: int | None, above: int | None) -> Bool[Tensor, " frames"]:
        column = torch.ones(len(observed), dtype=torch.bool)
        while joint is not None and joint >= 0 and joint != above:
            column = column & observed[:, joint]
            joint = parents[joint]
        return column

    aboves = [rigmap.joint_of[CANONICAL.parents[k]] if k else None for k in range(CANONICAL.num_joints)]
    columns = [are_observed(joint, above) for joint, above in zip(rigmap.joint_of, aboves, strict=True)]
    hips = rigmap.joint_of[0]
    return torch.stack(columns, dim=1), are_observed(None if hips is None else parents[hips], None)


def _propose(
    observation: _Observation, denoiser: Denoiser
) -> tuple[Motion, Float[Tensor, "frames 2"], Float[Tensor, "frames joints"]]:
    """Propose the motion on the performer's bones, contact logits, and the expected error of each of a joint's angles,
    radians, at the capture's rate. The denoiser sees every nth frame of the capture without what is too fast for that,
    or at low rates its frames with unobserved ones between them, so that no noise is interpolated: whole steps that
    come nearest to PRIOR_FPS."""
    canonical, skeleton, fps = observation.canonical, observation.rigmap.skeleton, float(observation.canonical.fps)
    scale = leg_length(CANONICAL) / leg_length(skeleton)
    step, between = max(1, round(fps / PRIOR_FPS)), max(1, round(PRIOR_FPS / fps))
    quats, root, kept = canonical.local_quat_xyzw, canonical.root_position, 1.0
    if step > 1:
        hertz = _LOW_PASS * fps / step
        quats = smooth_columns(quats, observation.seen.double(), hertz, fps)
        quats = torch.nn.functional.normalize(quats, dim=-1)
        root = smooth_columns(root[:, None], observation.seen_root.double()[:, None], hertz, fps)[:, 0]
        kept = measure_kept_noise(hertz, fps)
    last = canonical.num_frames - 1
    frames = torch.arange(0, last + step, step).repeat_interleave(between).clamp(max=last)
    thin = Motion(canonical.skeleton, Fraction(PRIOR_FPS), scale * root[frames], quats[frames])
    cleaned = denoiser.clean(
        observation.capture(thin, frames, torch.arange(len(frames)) % between == 0, kept=kept, scale=scale)
    )
    seconds = torch.arange(len(frames), dtype=torch.float64) * step / between / fps

    def follow(values: Tensor) -> Tensor:
        return values[::between] if step == 1 else upsample(values, seconds, fps=fps, frames=last + 1)

    quats = follow(rotations.make_sign_continuous(cleaned.pose.local_quat_xyzw[0].double()))
    root = follow(cleaned.pose.root_position[0].double()) / scale
    motion = Motion(skeleton, canonical.fps, root, torch.nn.functional.normalize(quats, dim=-1))
    return motion, follow(cleaned.contact_logits[0]), follow(cleaned.log_spread[0, :, 1:].double()).exp()


def _drifts(motion: Motion, error: Float[Tensor, "frames joints"], ground: Ground | None) -> bool:
    """Return whether standing toes slide as in estimates from video, tremor aside, and faster than the errors of the
    angles, radians, explain: those are smooth over SMOOTH_FRAMES."""
    fps, weights = float(motion.fps), torch.ones(motion.num_frames, motion.num_joints, dtype=torch.float64)
    quats = smooth_columns(motion.local_quat_xyzw, weights, _DRIFT_HERTZ, fps)
    root = smooth_columns(motion.root_position[:, None], weights[:, :1], _DRIFT_HERTZ, fps)[:, 0]
    smooth = replace(motion, root_position=root, local_quat_xyzw=torch.nn.functional.normalize(quats, dim=-1))
    away = float(error.square().mean().sqrt()) * leg_length(motion.skeleton)
    explained = away * PRIOR_FPS / (math.sqrt(2) * SMOOTH_FRAMES)  # as the derivative of errors so correlated
    return correct_trajectory(smooth.resample(PRIOR_FPS), explained, ground).from_video


_DRIFT_HERTZ = 3.0  # half-power frequency of what is not tremor
_VIDEO_NOISE_RATE = 15.0  # samples a second up to which noise of estimates from video is white
_LOW_PASS = 0.4  # of the rate of the frames that the denoiser sees: what is faster would be folded into them


def _fuse(
    observation: _Observation, proposal: Motion | None
) -> tuple[Motion, Float[Tensor, "frames joints"], Float[Tensor, "frames joints"]]:
    """Fuse the proposal, if there is one, with the capture; also the share of the proposal, and the error, radians,
    that remains."""
    capture, noise_rate = observation.canonical, observation.noise_rate
    angles, positions = (None, None) if proposal is None else (proposal.local_quat_xyzw, proposal.root_position)
    fps = float(capture.fps)
    turned = fuse_rotations(angles, capture.local_quat_xyzw, observation.seen, observation.sigma, fps, noise_rate)
    moved = fuse_positions(
        positions, capture.root_position, observation.seen_root, observation.sigma_root, fps, noise_rate
    )
    quats = rotations.make_sign_continuous(turned.values)
    fused = replace(
        capture, skeleton=observation.rigmap.skeleton, root_position=moved.values[:, 0], local_quat_xyzw=quats
    )
    return fused, turned.share, turned.error


_LOST_FRAMES = 8
"""Fewest consecutive frames without a joint that an in-betweener fills; shorter ones are the denoiser's own."""


@dataclass(frozen=True, eq=False)
class LostPartFiller(Denoiser):
    """A denoiser that leaves what is lost for longer to an in-betweener, which is shown all else denoised."""

    denoiser: Denoiser
    """Proposes what was observed, or lost for a moment."""
    inbetweener: Inbetweener
    """Proposes what was lost for longer."""

    def clean(self, capture: Capture) -> CaptureProposal:
        """Propose a motion of the capture's frames, on canonical bones at PRIOR_FPS.

        The denoiser's own answer stands for a batch of several captures, and where everything is lost throughout.
        """
        found = self.denoiser.clean(capture)
        lost = MissingMask(_find_lost(~capture.seen[0]), _find_lost(~capture.seen_root[0][:, None])[:, 0])
        if len(capture.root) != 1 or not (lost.joints.any() or lost.root.any()) or lost.joints.all():
            return found
        motion = BodyPose(**{name: values[0] for name, values in vars(found.pose).items()}).motion()
        seconds = torch.arange(motion.num_frames, dtype=torch.float64) / PRIOR_FPS
        proposed = self.inbetweener.propose(GapQuery(motion, lost, seconds)).motion
        pose = BodyPose.of_motion(restore_observed(proposed, motion, lost))
        return replace(found, pose=BodyPose(**{name: values[None] for name, values in vars(pose).items()}))


def _find_lost(unseen: Bool[Tensor, "frames columns"]) -> Bool[Tensor, "frames columns"]:
    lost = torch.zeros_like(unseen)
    for column, start, stop in true_intervals(unseen):
        lost[start:stop, column] = stop - start >= _LOST_FRAMES
    return lost
