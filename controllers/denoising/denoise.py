"""Denoise a capture on any rig (Wang et al. 2019, section 5.4).

1. Inspection (`mapctl.recording.inspection`): noise, spikes, drop-outs, held frames, bones that vary only by noise.
2. Proposal: a network that was trained on all kinds of motion sees the capture on canonical joints at PRIOR_FPS; an
   in-betweener proposes what is lost for longer.
3. Evidence test (`mapctl.recording.fusion`): the proposal is fused with the capture by the noise that the capture
   itself shows, so that on unfamiliar motion the result is a filter of the capture.
4. Refinement (`controllers.common.map_refinement`): the MAP problem about the fused motion plants the feet.
5. Result: on the capture's own rig, at its own rate, with all of its frames; the input where it would become rougher.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import linalg, ndimage
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, refine
from controllers.denoising.only_faults import keep_all_but_faults
from controllers.denoising.solution import DenoiseSolution, join_segments, move_frames
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery
from mapctl.metrics.faults import list_inspected_faults
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.problem.solution import Ledger, Outcome, Status
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
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES, leg_length
from mapctl.terms import Term

_SEGMENT_SECONDS = 60.0  # seconds of a long capture that are cleaned at once
_OVERLAP_SECONDS = 2.0  # seconds that two segments share
_LEAD_SIGMAS = 3.0  # noise of an angle within which a joint of a lead pose may differ from what is expected


CaptureKind: TypeAlias = Literal["studio", "video"]


@dataclass(frozen=True)
class DenoiseSettings:
    """Noise of the capture, and settings of the search."""

    sigma_deg: float | None = None
    """Noise of each of a joint's angles, degrees; estimated from the capture, joint by joint, if None."""
    sigma_cm: float | None = None
    """Noise of each coordinate of the hips, centimetres; estimated from the capture if None."""
    capture: CaptureKind = "studio"
    """Whether the trajectory is as good as the pose, or drifts and floats as in estimates from video: then planted feet
    and the floor correct it."""
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
    error = torch.where(observation.seen, error, spread)  # where nothing was observed, the model's own estimate
    shown = fused.resample(PRIOR_FPS)
    fps, last = float(motion.fps), motion.num_frames - 1
    at = (torch.arange(shown.num_frames) * fps / PRIOR_FPS).round().long().clamp(max=last)
    contacts = contacts[at]
    refined = refine(
        put_on_floor(shown) if settings.capture == "video" else shown,
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
    whole = bool(inspection.known.all() and inspection.seen_root.all()) and not terms and settings.capture == "studio"
    if whole and _measure_roughness(clean) > _measure_roughness(motion):
        start = first_frame / PRIOR_FPS
        notes = (f"frames from {start:.1f} s on would become rougher than they are: they were not changed",)
    return DenoiseSolution(
        motion if notes else clean,
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
    )


_FLOOR_SECONDS, _FLOOR_SMOOTH = 1.2, 0.2  # seconds in which a foot is on the floor, and sigma of the floor's height
_FLOOR_PERCENTILE = 15  # of the lower toe's height in that time
_NEAR, _SLOW = 0.03, 0.3  # metres over the floor and m/s at which a toe hardly stands
_SIGMA_STANDING, _SIGMA_STEP, _SIGMA_POSITION = 0.05, 0.15, 0.1  # m/s of a toe that stands, m/s and metres of the hips
_ROUNDS = 4  # solves: what stands is known by speeds, which a solve changes


def put_on_floor(motion: Motion) -> Motion:
    """Correct the trajectory of a canonical motion whose hips drift and float although its pose is right.

    The floor, the smoothed low percentile of the lower toe, is brought to the height at which toes rest over y = 0.
    Over the ground hips x minimise, by frame and coordinate, w (dx + df)^2 / s_standing^2 + (dx - do)^2 / s_step^2 +
    (x - o)^2 / s_position^2 with the captured hips o, toes f about the hips, and weights w of toes that are low and
    slow: a tridiagonal system, solved again as the speeds change (iteratively reweighted least squares, Holland and
    Welsch 1977).
    """
    fps, root = float(motion.fps), motion.root_position.numpy()
    toes = motion.joint_positions()[:, motion.skeleton.indices(TOES)].numpy()
    lower = toes[..., 1].min(axis=1)
    window = 2 * round(_FLOOR_SECONDS * fps / 2) + 1
    floor = ndimage.percentile_filter(lower, _FLOOR_PERCENTILE, window, mode="nearest")
    floor = ndimage.gaussian_filter1d(floor, _FLOOR_SMOOTH * fps, mode="nearest")
    above = toes[..., 1] - floor[:, None]
    near = np.exp(-np.maximum(above[1:], above[:-1]).clip(0) / _NEAR)
    seen = root[:, [0, 2]]
    steps, swings = np.diff(seen, axis=0), np.diff(toes[..., [0, 2]] - seen[:, None], axis=0)
    ground, frames, step = seen, len(root), (fps / _SIGMA_STEP) ** 2
    for _ in range(_ROUNDS):
        speed = fps * np.linalg.norm(np.diff(ground, axis=0)[:, None] + swings, axis=-1)
        stands = near / (1 + (speed / _SLOW) ** 2) * (fps / _SIGMA_STANDING) ** 2
        weight = stands.sum(axis=1) + step
        pulled = step * steps - (stands[..., None] * swings).sum(axis=1)
        bands, right = np.zeros((2, frames)), seen / _SIGMA_POSITION**2
        bands[1] = 1 / _SIGMA_POSITION**2
        bands[1, :-1] += weight
        bands[1, 1:] += weight
        bands[0, 1:] = -weight
        right[1:] += pulled
        right[:-1] -= pulled
        ground = linalg.solveh_banded(bands, right)
    rest = TOE_REST_HEIGHT * leg_length(motion.skeleton) / leg_length(CANONICAL)
    height = root[:, 1] - floor + rest
    moved = torch.from_numpy(np.stack([ground[:, 0], height, ground[:, 1]], axis=1))
    return replace(motion, root_position=moved.to(motion.root_position))


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

    @staticmethod
    def of(inspection: Inspection, settings: DenoiseSettings, rig: Rig) -> "_Observation":
        """Put an inspected recording on canonical joints, and estimate its noise there."""
        repaired = _smooth_noncanonical_joints(inspection, rig)
        canonical, rigmap = to_canonical(repaired, rig)
        canonical = replace(canonical, local_quat_xyzw=choose_continuous_signs(canonical.local_quat_xyzw))
        seen, above_hips = _map_to_canonical(inspection.known, rigmap)
        seen_root = inspection.seen_root & above_hips
        sigma = estimate_angle_noise(canonical.local_quat_xyzw, seen)
        if settings.sigma_deg is not None:
            # Joints that never move have no noise either: they are locked, or the rig has none there.
            sigma = torch.where(sigma > 0, math.radians(settings.sigma_deg), 0.0).to(sigma)
        root = estimate_position_noise(canonical.root_position, seen_root)
        sigma_root = root if settings.sigma_cm is None else settings.sigma_cm / 100
        return _Observation(repaired, rigmap, canonical, seen, seen_root, sigma, sigma_root)

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


_LOW_PASS = 0.4  # of the rate of the frames that the denoiser sees: what is faster would be folded into them


def _fuse(
    observation: _Observation, proposal: Motion
) -> tuple[Motion, Float[Tensor, "frames joints"], Float[Tensor, "frames joints"]]:
    """Fuse the proposal with the capture; also the share of the proposal, and the error, radians, that remains."""
    capture, fps = observation.canonical, float(observation.canonical.fps)
    turned = fuse_rotations(proposal.local_quat_xyzw, capture.local_quat_xyzw, observation.seen, observation.sigma, fps)
    moved = fuse_positions(
        proposal.root_position, capture.root_position, observation.seen_root, observation.sigma_root, fps
    )
    quats = rotations.make_sign_continuous(turned.values)
    fused = replace(proposal, root_position=moved.values[:, 0], local_quat_xyzw=quats)
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
