"""Inspection of a recording: values that leap or are held, and the noise of the rest.

- Spikes: single frames, or two in a row, that the frames around them do not explain. A local polynomial that leaves a
  frame out predicts it; how well it fits the neighbours scales the error (externally studentised residuals, Cook and
  Weisberg 1982, section 2.2.1). The scale of one window has few degrees of freedom, so it is shrunk to that of the
  whole track as far as windows differ no more than by chance (Smyth 2004, section 4). A frame is a spike where it is
  likelier anywhere at all than where its neighbours lead, unless its removal leaves a kink of that size, as at the
  turning point of a kick.
- Replaced values: a joint, or the whole body, that leaps to a value and keeps it, or is zero for a frame.
- Held values: a joint, or the whole body, that keeps its value while the motion goes on, so that the last value lags
  behind, or whose white noise stops. What rests comes to rest and leaves it again.
- Stretched bones: offsets in six-channel files that vary only by noise.
- Lead pose: a T-pose in frame 0 that does not belong to the motion, and the frames after it that an exporter's filter
  blended with it.
- Swapped limbs: left and right are exchanged for a few frames, as by a tracker that mistakes its labels. They are
  exchanged back where the frames beside predict that better than what was captured, by the Bayes factor of all joints
  of both limbs; what neither explains may be an outlier, so that no single joint decides (Kass and Raftery 1995).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter
from scipy.stats import norm
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, last_observed, true_intervals, widen
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks
from mapctl.recording.noise_estimation import (
    RESOLUTION,
    choose_continuous_signs,
    estimate_angle_noise,
    estimate_position_noise,
)
from mapctl.retarget import RigMap, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

_NOISE_DEG, _NOISE_CM = 0.5, 0.2  # least noise of angles and positions that is listed: optical capture has as much
MIN_FRAMES = 8
"""Fewest frames of a recording whose noise can be estimated."""
_RIG_FRAMES = 3000  # frames from which the rig is identified
_LOCKED_CHANGE = 1e-6  # of a quaternion, that rounding leaves of a joint which never moves


@dataclass(frozen=True)
class Artefact:
    """One artefact of a recording."""

    joint: str
    """Name of the joint on the recording's rig."""
    start: int
    """First frame, from 0."""
    stop: int
    """One past the last frame."""
    kind: str
    """noise, spike, dropout, frozen, swap, smoothed, slide, float, penetration, or stretch: an offset of a bone that
    varies only by noise."""
    amount: float
    """Noise's sigma, height of a floating toe, depth of penetration, length of a slide, largest error of an offset,
    loss of detail; of others the largest distance from what the frames around lead to."""
    unit: str


def list_artefacts(
    names: Sequence[str],
    wrong: Bool[Tensor, "frames columns"],
    kind: str,
    unit: str,
    amounts: Float[Tensor, "frames columns"],
    total: Callable[[Tensor], Tensor] = torch.max,
) -> list[Artefact]:
    """List runs of frames by column, each with the largest of its amounts, or their `total`."""
    return [
        Artefact(names[k], start, stop, kind, float(total(amounts[start:stop, k])), unit)
        for k, start, stop in true_intervals(wrong)
    ]


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording on its own rig, with masks of its artefacts."""

    motion: Motion
    """The recording, unchanged."""
    spikes: Bool[Tensor, "frames joints"]
    """Whether a joint's rotation is a spike."""
    dropouts: Bool[Tensor, "frames joints"]
    """Whether a joint is masked, held or replaced."""
    spikes_root: Bool[Tensor, " frames"]
    """Whether the position is a spike."""
    dropouts_root: Bool[Tensor, " frames"]
    """Whether the position is masked."""
    frozen: Bool[Tensor, " frames"]
    """Whether the whole body is held, or zero, while it moves; all joints are dropouts there."""
    noise: Float[Tensor, " joints"]
    """Noise sigma of each of a joint's three angles, radians."""
    noise_root: float
    """Noise sigma of each coordinate of the position, metres."""

    @property
    def seen(self) -> Bool[Tensor, "frames joints"]:
        """Observation mask of rotations: neither spike nor missing."""
        return ~(self.spikes | self.dropouts)

    @property
    def seen_root(self) -> Bool[Tensor, " frames"]:
        """Observation mask of the position: neither spike nor missing."""
        return ~(self.spikes_root | self.dropouts_root)

    @cached_property
    def known(self) -> Bool[Tensor, "frames joints"]:
        """Mask of rotations that are observed, or need not be, since the joint is the same wherever it is."""
        quats = self.motion.local_quat_xyzw
        still = (quats - self._held()[:1]).norm(dim=-1) < _LOCKED_CHANGE
        return self.seen | ((still | ~self.seen).all(dim=0) & self.seen.any(dim=0))

    def _held(self) -> Float[Tensor, "frames joints 4"]:
        """Hold the last observed rotation where none is observed: signs are then chosen between frames that count."""
        return torch.take_along_dim(self.motion.local_quat_xyzw, last_observed(self.seen.T).T[..., None], dim=0)

    def repaired(self) -> Motion:
        """Return the recording with artefacts filled in, interpolated from the frames around them."""
        motion, seen = self.motion, self.seen
        quats = choose_continuous_signs(self._held())
        steps = fill_missing(quats.transpose(0, 1), seen.T).transpose(0, 1)
        filled = fill_missing(travel(motion)[None], self.seen_root[None])[0]
        motion = replace(motion, local_quat_xyzw=torch.nn.functional.normalize(steps, dim=-1))
        if joint := motion.travelling_joint:
            return replace(motion, moving_offsets={**motion.moving_offsets, joint: filled})
        return replace(motion, root_position=filled)


def travel(motion: Motion) -> Float[Tensor, "frames 3"]:
    """Return the position of the joint that travels: the root's, or that of one below it in its parent, metres."""
    joint = motion.travelling_joint
    return motion.moving_offsets[joint] if joint else motion.root_position


def correct_structure(
    motion: Motion, rig: Rig | None, hidden: Bool[Tensor, "frames joints"]
) -> tuple[Motion, RigMap, Float[Tensor, " lead"], list[Artefact]]:
    """Hold bones that stretch by noise and exchange swapped limbs; also return the rig, identified once, since later
    frames may lack its T-pose, the shares of the lead pose (see `estimate_lead_shares`), and the faults.

    Of `hidden` rotations nothing is inferred. RequestError where the rig's joints cannot be identified.
    """
    motion, stretched = hold_rigid_bones(motion) if motion.num_frames >= MIN_FRAMES else (motion, [])
    beginning, rigmap = to_canonical(motion.slice(0, min(motion.num_frames, _RIG_FRAMES)), rig)
    motion, swapped = exchange_swapped_limbs(motion, rigmap, hidden)
    return motion, rigmap, estimate_lead_shares(beginning), [*stretched, *swapped]


def inspect_recording(motion: Motion, masks: Sequence[Mask] = ()) -> Inspection:
    """Inspect a recording on any rig; RequestError for masks that name joints or frames it has not."""
    quats, position = choose_continuous_signs(motion.local_quat_xyzw), travel(motion)
    hidden = expand_valid_masks(motion, masks)
    spikes, spikes_root = find_angle_spikes(quats, ~hidden.joints), find_position_spikes(position, ~hidden.root)
    held, frozen = _find_held_frames(quats, position, hidden.joints | spikes, hidden.root | spikes_root)
    dropouts, dropouts_root = hidden.joints | held | frozen[:, None], hidden.root | frozen
    # What is found to be false explains no other frame, and each spike corrupts the differences around it.
    spikes, spikes_root = find_angle_spikes(quats, ~dropouts), find_position_spikes(position, ~dropouts_root)
    noise = estimate_angle_noise(quats, ~(dropouts | spikes))
    noise_root = estimate_position_noise(position, ~(dropouts_root | spikes_root))
    return Inspection(motion, spikes, dropouts, spikes_root, dropouts_root, frozen, noise, noise_root)


def list_value_artefacts(inspection: Inspection) -> list[Artefact]:
    """List noise, spikes, drop-outs and frozen frames, each by how far it is from what the frames around lead to."""
    motion, repaired, names = inspection.motion, inspection.repaired(), inspection.motion.skeleton.names
    turned = torch.rad2deg(rotations.turns_between(motion.local_quat_xyzw, repaired.local_quat_xyzw).norm(dim=-1))
    moved = 100 * (travel(repaired) - travel(motion)).norm(dim=-1, keepdim=True)
    travelling, frozen = [names[motion.travelling_joint]], inspection.frozen[:, None]
    noise = [*zip(names, torch.rad2deg(inspection.noise).tolist(), strict=True)]
    found = [
        Artefact(name, 0, motion.num_frames, "noise", sigma, "deg") for name, sigma in noise if sigma >= _NOISE_DEG
    ]
    if 100 * inspection.noise_root >= _NOISE_CM:
        found.append(Artefact(travelling[0], 0, motion.num_frames, "noise", 100 * inspection.noise_root, "cm"))
    found += list_artefacts(names, inspection.spikes, "spike", "deg", turned)
    found += list_artefacts(travelling, inspection.spikes_root[:, None], "spike", "cm", moved)
    found += list_artefacts([ALL], frozen, "frozen", "deg", turned.amax(dim=1, keepdim=True))
    found += list_artefacts(names, inspection.dropouts & ~frozen, "dropout", "deg", turned)
    found += list_artefacts(travelling, inspection.dropouts_root[:, None] & ~frozen, "dropout", "cm", moved)
    return found + list_smoothed(motion)


_SMOOTH_SECONDS, _SMOOTH_DB = 0.6, 13.0  # of a window, and by how much weaker its detail is than at that speed
_STEP_SECONDS, _LEAST_TURN = 1 / 30, 0.003  # of a difference, and radians in that time of a joint that moves


def list_smoothed(motion: Motion) -> list[Artefact]:
    """List spans in which the whole body was smoothed: detail, the fourth differences of joints' turns, is weaker than
    the clip has at that speed, in the median of the joints that move. One joint alone does not show it."""
    fps, quats = float(motion.fps), motion.local_quat_xyzw
    step, side = max(1, round(_STEP_SECONDS * fps)), round(_SMOOTH_SECONDS * fps / 2)
    if motion.num_frames < 8 * side + 5 * step:
        return []
    turns = detail = rotations.turns_between(quats[:-step], quats[step:])
    for _ in range(4):
        detail = detail[step:] - detail[:-step]

    def measure_level(values: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "joints frames"]:
        power = values.square().sum(dim=-1).T[None]
        mean = torch.nn.functional.avg_pool1d(power, 2 * side + 1, 1, side, count_include_pad=False)
        return 10 * (mean[0] + 1e-16).log10()

    speed, level = measure_level(turns[2 * step :][: len(detail)]), measure_level(detail)
    moves = speed > 20 * math.log10(_LEAST_TURN)
    usual = moves.double().mean(dim=1) > 0.5
    if not usual.any():
        return []
    speed, level, moves = speed[usual], level[usual], moves[usual]
    away = speed - speed.mean(dim=1, keepdim=True)
    slope = (away * level).sum(dim=1, keepdim=True) / away.square().sum(dim=1, keepdim=True).clamp_min(1e-6)
    weaker = torch.where(moves, level.mean(dim=1, keepdim=True) + slope * away - level, 0.0).median(dim=0).values
    before = (motion.num_frames - len(weaker)) // 2
    spans = list_artefacts([ALL], widen(weaker > _SMOOTH_DB, side)[:, None], "smoothed", "dB", weaker[:, None])
    return [replace(span, start=span.start + before, stop=span.stop + before) for span in spans]


def find_gaps(motion: Motion) -> tuple[Mask, ...]:
    """Find the gaps of a motion that no mask gives; RequestError if there are none."""
    found = inspect_recording(motion)
    frozen = found.frozen[:, None]
    columns = torch.cat([frozen, ~found.seen & ~frozen, ~found.seen_root[:, None] & ~frozen], dim=1)
    names = (ALL, *motion.skeleton.names, ROOT)
    masks = tuple(Mask(names[column], start, stop) for column, start, stop in true_intervals(columns))
    if not masks:
        raise RequestError("no frame is frozen and none leaps: give the missing frames (--gap A:B) or joints")
    return masks


# Predictions of a frame from its neighbours. Neighbours on either side and degree: narrow windows follow quick motion,
# wide ones average noise; of these the one that predicts a track best by its likelihood is used (Geisser 1975).
_MODELS = ((2, 1), (3, 3), (4, 3), (6, 3), (6, 2))
_AXES = 3  # degrees of freedom of a rotation and of a position
_LEAST_SPREAD = 1e-3  # variance of the logarithm of windows' scales, below which all have one: 2,000 degrees of freedom


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictions of every frame of every track from its neighbours, (frames, tracks)."""

    mean: Float[Tensor, "frames tracks width"]
    """Prediction of the value."""
    error: Float[Tensor, "frames tracks"]
    """Distance of the value from the prediction."""
    spread: Float[Tensor, "frames tracks"]
    """Standard deviation of each coordinate about a polynomial, from the neighbours."""
    scale: Float[Tensor, "frames tracks"]
    """Standard error of each coordinate of the prediction."""
    freedom: Float[Tensor, "frames tracks"]
    """Degrees of freedom of the scale; 0 where too few neighbours are seen."""

    def log_density(self) -> Float[Tensor, "frames tracks"]:
        """Return the logarithm of the density of each error, Student's t of three coordinates; 0 where unknown."""
        freedom = self.freedom.clamp_min(1e-3)
        square = self.scale.square()
        density = torch.lgamma((freedom + _AXES) / 2) - torch.lgamma(freedom / 2)
        density = density - _AXES / 2 * (math.pi * freedom * square).log()
        density = density - (freedom + _AXES) / 2 * torch.log1p(self.error.square() / (freedom * square))
        return torch.where(self.freedom > 0, density, 0.0)


def predict_frames(
    values: Float[Tensor, "frames tracks width"], seen: Bool[Tensor, "frames tracks"], least: Float[Tensor, " tracks"]
) -> Prediction:
    """Predict each frame of each track from those of its neighbours that are seen; `least` is the smallest scale that
    a track can have, its resolution."""
    found, scores = [_predict(values, seen, least, side, degree) for side, degree in _MODELS], []
    for prediction in found:  # the mean logarithm of the density of the frames that are seen
        counted = seen & (prediction.freedom > 0)
        total = torch.where(counted, prediction.log_density(), 0.0).sum(dim=0)
        scores.append(torch.where(counted.any(dim=0), total / counted.sum(dim=0).clamp_min(1), -math.inf))
    usable = torch.stack([prediction.freedom > 0 for prediction in found])
    rank = torch.stack(scores).argsort(dim=0).argsort(dim=0)[:, None]
    best = torch.where(usable, rank, -1).argmax(dim=0, keepdim=True)
    numbers = ([getattr(each, name) for each in found] for name in ("error", "spread", "scale", "freedom"))
    mean = torch.take_along_dim(torch.stack([each.mean for each in found]), best[..., None], dim=0)[0]
    return Prediction(mean, *(torch.stack(each).gather(0, best)[0] for each in numbers))


def _predict(
    values: Float[Tensor, "frames tracks width"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
    side: int,
    degree: int,
) -> Prediction:
    """Predict by polynomials of one degree over so many neighbours on either side."""
    lags = torch.arange(-side, side + 1, dtype=values.dtype) / side
    powers = lags ** torch.arange(2 * degree + 1)[:, None]
    powers[:, side] = 0  # the frame itself is left out
    centre, known = values.mean(dim=0), seen.to(values)
    values = values - centre

    def sum_over_lags(column: Tensor, weights: Tensor) -> Tensor:  # beyond the ends there is nothing
        return torch.nn.functional.conv1d(column.T[:, None], weights[:, None], padding=side).permute(2, 0, 1)

    moments = sum_over_lags(known, powers)
    shown = values * known[..., None]
    sums = torch.stack([sum_over_lags(shown[..., axis], powers[: degree + 1]) for axis in range(shown.shape[-1])], -1)
    squares = sum_over_lags(shown.square().sum(dim=-1), powers[:1])[..., 0]
    # The normal equations of the polynomials; windows of which all frames are seen have one inverse.
    order = torch.arange(degree + 1)
    normal, ridge = moments[..., order[:, None] + order], 1e-9 * torch.eye(degree + 1, dtype=moments.dtype)
    full = moments[..., 0] > moments[..., 0].amax() - 0.5
    inverse = torch.linalg.inv(normal[full][0] + ridge).expand_as(normal).clone()
    inverse[~full] = torch.linalg.inv(normal[~full] + ridge)
    mean = torch.einsum("ftp,ftpw->ftw", inverse[..., 0, :], sums)
    residual = (squares - torch.einsum("ftpw,ftpq,ftqw->ft", sums, inverse, sums)).clamp_min(0)
    freedom = _AXES * (moments[..., 0].round() - (degree + 1)).clamp_min(0)
    shrunk, shared = _shrink_scale(residual, freedom, seen, least.square())
    total = torch.where(freedom > 0, freedom + shared, 0.0)
    # A moment of rest is no reason to expect none of the motion that the track has otherwise.
    usual = torch.where(seen & (total > 0), shrunk, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    scale = (torch.maximum(shrunk, usual) * (1 + inverse[..., 0, 0].clamp_min(0))).sqrt()
    return Prediction(mean + centre, (values - mean).norm(dim=-1), shrunk.sqrt(), scale, total)


def _shrink_scale(
    residual: Float[Tensor, "frames tracks"],
    freedom: Float[Tensor, "frames tracks"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
) -> tuple[Float[Tensor, "frames tracks"], Float[Tensor, " tracks"]]:
    """Return the windows' mean squares, shrunk to their track's (Smyth 2004, section 6.2: the moments of their
    logarithms), and the degrees of freedom of that."""
    counted, half = seen & (freedom > 0), freedom.clamp_min(1) / 2
    square = torch.maximum(residual / freedom.clamp_min(1), least)
    logarithm = square.log() - torch.digamma(half) + half.log()
    count = counted.sum(dim=0).clamp_min(1)
    mean = torch.where(counted, logarithm, 0.0).sum(dim=0) / count
    spread = torch.where(counted, (logarithm - mean).square(), 0.0).sum(dim=0) / (count - 1).clamp_min(1)
    spread -= torch.where(counted, torch.special.polygamma(1, half), 0.0).sum(dim=0) / count
    value = spread.clamp_min(_LEAST_SPREAD)
    shared = 0.5 + 1 / value
    for _ in range(10):  # trigamma(shared) = value by Newton's method (Smyth 2004, appendix)
        trigamma = torch.special.polygamma(1, shared)
        shared = shared + trigamma * (1 - trigamma / value) / torch.special.polygamma(2, shared)
    usual = (mean + torch.digamma(shared) - shared.log()).exp()
    shrunk = (2 * shared * usual + residual) / (2 * shared + freedom)
    return torch.maximum(shrunk, least), 2 * shared


_MEDIAN_FRAMES = 5  # frames of the running median: bursts of up to two are detected
_CANDIDATE_RATIO, _CANDIDATE_FRAMES = 3.0, 13  # distance from the median, by its median over so many frames
SHARE = 0.01  # of a track's frames that is expected to spike
ROTATIONS = 4 / 3 * math.pi * math.pi**3  # volume of all rotation vectors, among which a false rotation may be any
_BODY = 4 / 3 * math.pi * 2.0**3  # volume about a body, cubic metres, within which its false position lies
_FIT_ROUNDS = 5


def find_angle_spikes(
    quats: Float[Tensor, "frames joints 4"], seen: Bool[Tensor, "frames joints"]
) -> Bool[Tensor, "frames joints"]:
    """Find which joints spike in which frames that are seen."""
    return find_spikes(2 * choose_continuous_signs(quats), seen, math.log(SHARE / ROTATIONS))


def find_position_spikes(
    positions: Float[Tensor, "frames 3"], seen: Bool[Tensor, " frames"]
) -> Bool[Tensor, " frames"]:
    """Find the frames in which the position spikes; metres."""
    return find_spikes(positions[:, None], seen[:, None], math.log(SHARE / _BODY))[:, 0]


def find_spikes(
    values: Float[Tensor, "frames tracks width"], seen: Bool[Tensor, "frames tracks"], log_density: float
) -> Bool[Tensor, "frames tracks"]:
    """Find the candidates that are likelier anywhere at all, `log_density`, than where their neighbours lead.
    Neighbours that spike explain nothing: first no candidate counts as a neighbour, then all that were none."""
    # Candidates are further from the running median than most about them; more than can spike.
    numbers = values.numpy()
    away = np.linalg.norm(numbers - median_filter(numbers, (_MEDIAN_FRAMES, 1, 1), mode="mirror"), axis=-1)
    frames = 2 * min(_CANDIDATE_FRAMES // 2, len(away) - 1) + 1
    usual = median_filter(away, (frames, 1), mode="mirror")
    candidates = torch.from_numpy(away > _CANDIDATE_RATIO * usual + RESOLUTION) & seen
    spikes = candidates.clone()
    changed = candidates.any(dim=0)
    for _ in range(_FIT_ROUNDS):
        if not changed.any():
            break
        open_ = changed.nonzero()[:, 0]
        least = values.new_full((len(open_),), RESOLUTION)
        prediction = predict_frames(values[:, open_], (seen & ~spikes)[:, open_], least)
        found = candidates[:, open_] & (prediction.log_density() < log_density)
        changed[open_] = (found != spikes[:, open_]).any(dim=0) & found.any(dim=0)
        spikes[:, open_] = found
    for track, start, stop in true_intervals(spikes):
        if stop - start > _MEDIAN_FRAMES // 2 or not _is_rough(values[:, track], ~spikes[:, track], start, stop):
            spikes[start:stop, track] = False
    return spikes


def _is_rough(values: Float[Tensor, "frames width"], kept: Bool[Tensor, " frames"], start: int, stop: int) -> bool:
    """Return whether frames `start` to `stop` stand out further than what is left without them. Amid a track they lie
    further from the line between the kept frames beside them than these turn there. At an end, which is seen from one
    side, they lie further from the line through the next two than any other frame does."""
    before, after = kept[:start].nonzero()[-2:, 0], stop + kept[stop:].nonzero()[:2, 0]
    if len(before) == 2 and len(after) == 2:
        pairs = (before.tolist(), [int(before[1]), int(after[0])], after.tolist())
        slopes = [(values[second] - values[first]) / (second - first) for first, second in pairs]
        away = torch.arange(start, stop)[:, None] - before[1]
        leap = (values[start:stop] - values[before[1]] - away * slopes[1]).norm(dim=-1).amax()
        return bool(leap > max((slopes[1] - slopes[0]).norm(), (slopes[2] - slopes[1]).norm()))
    rest = values[kept]
    if len(rest) < _MEDIAN_FRAMES:
        return False
    near, far, end = (rest[0], rest[1], values[start]) if start == 0 else (rest[-1], rest[-2], values[stop - 1])
    return bool((end - (2 * near - far)).norm() > torch.diff(rest, n=2, dim=0).norm(dim=-1).amax())


_QUIET = 0.01  # chance of a window that is as quiet as those beside a rest
_WHITE = 100.0  # degrees of freedom from which the windows of a track have one scale: noise, which never rests


class _Run(NamedTuple):
    """Frames `start` to `stop`, in which some tracks have one value."""

    start: int
    stop: int
    tracks: slice


def _find_held_frames(
    quats: Float[Tensor, "frames joints 4"],
    position: Float[Tensor, "frames 3"],
    ignored: Bool[Tensor, "frames joints"],
    ignored_root: Bool[Tensor, " frames"],
) -> tuple[Bool[Tensor, "frames joints"], Bool[Tensor, " frames"]]:
    """Find the frames in which a joint is held or replaced, and those in which the whole body is, its position
    included. What all hold to the end is a rest. `ignored` are frames that are known to be false."""
    values = torch.cat([2 * quats, torch.nn.functional.pad(position, (0, 1))[:, None]], dim=1)
    ignored = torch.cat([ignored, ignored_root[:, None]], dim=1)
    held, frozen = torch.zeros_like(ignored), torch.zeros(len(values), dtype=torch.bool)
    equal = torch.zeros_like(held)
    equal[1:] = (values[1:] == values[:-1]).all(dim=-1)
    moving = ((values - values[0]).norm(dim=-1) > RESOLUTION).any(dim=0).nonzero()[:, 0]
    if len(moving) == 0:
        return held[:, :-1], frozen
    turning = (quats != quats[:1]).any(dim=-1).any(dim=0)
    zero = (quats[:, turning, :3] == 0).all(dim=-1).all(dim=-1) & turning.any()
    volumes = quats.new_tensor([ROTATIONS] * quats.shape[1] + [_BODY])[moving]
    values, ignored, equal = values[:, moving], ignored[:, moving], equal[:, moving]
    whole = equal.all(dim=1)
    runs = [_Run(start - 1, stop, slice(None)) for _, start, stop in true_intervals(whole[:, None])]
    alone = zero & ~whole & ~torch.roll(whole, -1)
    runs += [_Run(start, stop, slice(None)) for _, start, stop in true_intervals(alone[:, None])]
    inner = [run for run in runs if run.start > 0 and run.stop < len(values)]
    for run in _find_faults(inner, values, ignored, volumes):
        frozen[run.start : run.stop] = True
    own = true_intervals(equal & ~whole[:, None])
    runs = [_Run(start - 1, stop, slice(track, track + 1)) for track, start, stop in own]
    for run in _find_faults(runs, values, ignored | frozen[:, None], volumes):
        held[run.start : run.stop, moving[run.tracks]] = True
    return held[:, :-1], frozen


def _find_faults(
    runs: Sequence[_Run],
    values: Float[Tensor, "frames tracks width"],
    ignored: Bool[Tensor, "frames tracks"],
    volumes: Float[Tensor, " tracks"],
) -> list[_Run]:
    """Return the frames of the runs that are no motion, without their first where it still is. A run is replaced whose
    first value is likelier anywhere in `volumes` than where the motion leads, and further from the line through the two
    frames before it than any other; it is held where its last value lags behind."""
    if not runs or len(values) < 3:
        return []
    steps = torch.diff(values, dim=0).norm(dim=-1)
    least = torch.where(steps > 0, steps, math.inf).amin(dim=0).clamp_min(RESOLUTION)
    equal = torch.zeros_like(ignored)
    for run in runs:
        equal[run.start + 1 : run.stop, run.tracks] = True
    seen = ~(ignored | equal)
    free = seen.clone()
    for run in runs:
        free[run.start, run.tracks] = False
    bends = torch.diff(values, n=2, dim=0).norm(dim=-1)
    usual = torch.where(free[2:] & free[1:-1] & free[:-2], bends, 0.0).amax(dim=0)
    ahead, behind = torch.zeros(2, *seen.shape, dtype=torch.bool)
    ahead[2:] = behind[:-2] = bends > usual
    unlikely = predict_frames(values, seen, least).log_density() + volumes.log() < -math.log(len(values))
    replaced = [bool((unlikely & ahead)[run.start, run.tracks].any()) for run in runs]
    for run, wrong in zip(runs, replaced, strict=True):
        seen[run.start, run.tracks] &= not wrong
    prediction = predict_frames(values, seen, least)
    loud = _find_loud(prediction, ~equal)
    faults = [run for run, wrong in zip(runs, replaced, strict=True) if wrong]
    for run, wrong in zip(runs, replaced, strict=True):
        if wrong or run.stop - run.start == 1:
            continue
        # Most tracks are noise, beside the run as ever. Frames of noise are equal by chance if all three numbers are
        # within the resolution.
        beside = [frame for frame in (run.start, run.stop) if 0 < frame < len(loud)]
        noisy = loud[beside][:, run.tracks].all(dim=0)
        ratio = prediction.spread[beside][:, run.tracks].amin(dim=0) / least[run.tracks]
        chance = 3 * (run.stop - run.start - 1) * float(torch.where(noisy, ratio.log(), 0.0).sum())
        stops_trembling = float(noisy.double().mean()) > 0.5 and chance > math.log(len(loud))
        if stops_trembling or _lags(run, values, prediction, ahead, behind):
            faults.append(_Run(run.start + 1, run.stop, run.tracks))
    return faults


def _find_loud(prediction: Prediction, free: Bool[Tensor, "frames tracks"]) -> Bool[Tensor, "frames tracks"]:
    """Find frames of noisy tracks no more quiet than those that are `free` (Wilson and Hilferty 1931: chi-squared)."""
    spread, freedom = prediction.spread, prediction.freedom
    usual = torch.where((freedom > 0) & free, spread, math.nan).nanmedian(dim=0).values
    part = 2 / (9 * freedom.clamp_min(1))
    least = (1 - part + float(norm.ppf(_QUIET)) * part.sqrt()).clamp_min(0) ** 3
    return (freedom > _WHITE) & (spread.square() > least * usual.square())


def _lags(
    run: _Run,
    values: Float[Tensor, "frames tracks width"],
    prediction: Prediction,
    ahead: Bool[Tensor, "frames tracks"],
    behind: Bool[Tensor, "frames tracks"],
) -> bool:
    """Return whether the last value is likelier behind the motion after it, by a step to the next frame, than where
    that leads back to, and leaps. Where no frame is known after the run its beginning counts."""
    tracks, leaps, last, other = run.tracks, behind, run.stop - 1, run.stop
    if run.stop == len(values) or not bool((prediction.freedom[last, tracks] > 0).any()):
        leaps, last, other = ahead, run.start + 1, run.start - 1
    if other < 0:
        return False
    step = (values[other, tracks] - values[last, tracks]).norm(dim=-1)
    square = prediction.scale[last, tracks].square() + step.square() / 3
    lagging = -1.5 * (2 * math.pi * square).log() - prediction.error[last, tracks].square() / (2 * square)
    known = prediction.freedom[last, tracks] > 0
    evidence = torch.where(known, lagging - prediction.log_density()[last, tracks], 0.0)
    return float(evidence.sum()) > math.log(len(values)) and bool(leaps[last, tracks].any())


_NO_TRAVEL = 1e-3  # metres by which a rigid bone may vary where no noise is measured
_NOISE_SIGMAS = 5.0  # noise of one frame, and of a block's median, that a rigid bone may show
_SPIKE_SECONDS, _BLOCK_SECONDS = 1 / 30, 0.5
_MEDIAN_NOISE = 1.2533  # standard deviation of a median by that of a mean


def hold_rigid_bones(motion: Motion) -> tuple[Motion, list[Artefact]]:
    """Return the motion with the median offset of every joint whose offset varies only by noise, and these as faults.

    The joint that travels stays, and so does one whose offset drifts or differs for more than a frame, as in rigs that
    stretch. An offset of zero counts as lost.
    """
    moving, faults = dict(motion.moving_offsets), []
    for joint, track in motion.moving_offsets.items():
        held = None if joint == motion.travelling_joint else _find_rigid_offset(track, float(motion.fps))
        if held is not None:
            moving[joint] = held.expand_as(track)
            amount = 100 * float((track - held).norm(dim=-1).max())
            faults.append(Artefact(motion.skeleton.names[joint], 0, motion.num_frames, "stretch", amount, "cm"))
    return replace(motion, moving_offsets=moving), [fault for fault in faults if fault.amount >= _NOISE_CM]


def _find_rigid_offset(track: Float[Tensor, "frames 3"], fps: float) -> Float[Tensor, "3"] | None:
    """Return the median of an offset that varies only by noise, of frames in which it is not zero; None for others."""
    known = track.any(dim=-1)
    if not known.any():
        return None
    median = track[known].median(dim=0).values
    away = torch.where(known[:, None], track - median, 0.0)
    noise = torch.tensor([estimate_position_noise(track[:, [axis] * 3], known) for axis in range(3)]).to(track)
    apart = (away.abs() > (_NOISE_SIGMAS * noise).clamp_min(_NO_TRAVEL)).any(dim=-1, keepdim=True)
    if any(stop - start > max(1, round(_SPIKE_SECONDS * fps)) for _, start, stop in true_intervals(apart)):
        return None
    size = max(1, min(len(track), round(_BLOCK_SECONDS * fps)))
    drift = away.unfold(0, size, size).median(dim=-1).values.abs()
    allowed = _NOISE_SIGMAS * _MEDIAN_NOISE * noise / size**0.5
    return None if (drift > allowed.clamp_min(_NO_TRAVEL)).any() else median


_STRAIGHT, _ARMS_OUT, _ARMS_DOWN = math.radians(15), math.radians(25), math.radians(40)  # turns from the T-pose
_LINE_SECONDS, _LEAST_LINE = 0.1, 6  # seconds and frames from which the motion is extrapolated to its beginning
_BLEND_SECONDS, _LEAST_BLEND = 0.06, 4  # longest blend, the longer of the two
_UNBLENDED = 0.9  # share of the motion from which a frame is free of the pose


def estimate_lead_shares(canonical: Motion) -> Float[Tensor, " lead"]:
    """Estimate the share of the motion in each frame of a lead pose: 0 in frame 0, rising in those that an exporter's
    filter blended with it; no frames where a motion on canonical joints has none.

    A lead pose has its arms out and all joints straight, and the motion, which has its arms down in most frames, does
    not extrapolate to it. The share of the motion in each frame after it is fitted by least squares to all joints.
    """
    turned = rotations.to_rotation_vector(canonical.local_quat_xyzw[:, 1:]).norm(dim=-1)
    upper = [CANONICAL.index(name) - 1 for name in ("leftUpperArm", "rightUpperArm")]
    arms = turned[:, upper].amin(dim=-1)
    straight = bool(turned[0].mean() < _STRAIGHT) and bool(arms[0] < _ARMS_OUT)
    if len(arms) < 2 or not straight or not bool(arms[1:].median() > _ARMS_DOWN):
        return torch.zeros(0)
    fps, after = float(canonical.fps), canonical.num_frames - 1
    longest = min(max(_LEAST_BLEND, math.ceil(_BLEND_SECONDS * fps)), after - 4)
    if longest < 1:
        return torch.zeros(1)
    fitted = min(max(_LEAST_LINE, round(_LINE_SECONDS * fps)), after - longest)
    quats = rotations.make_sign_continuous(canonical.local_quat_xyzw[:, 1:])
    frames = torch.arange(canonical.num_frames, dtype=quats.dtype)[1:]
    line = torch.linalg.lstsq(
        torch.stack([torch.ones(fitted).to(quats), frames[longest : longest + fitted]], dim=-1),
        quats[1 + longest :][:fitted].flatten(1),
    ).solution
    ahead = (line[0] + frames[:longest, None] * line[1]).unflatten(-1, quats.shape[1:])
    ahead = torch.nn.functional.normalize(ahead, dim=-1)
    if bool((rotations.to_rotation_vector(ahead[0, upper]).norm(dim=-1) < _ARMS_OUT).all()):
        return torch.zeros(0)
    whole, gone = (rotations.turns_between(quats[:1], each) for each in (ahead, quats[1 : 1 + longest]))
    share = (whole * gone).sum(dim=(-1, -2)) / whole.square().sum(dim=(-1, -2)).clamp_min(1e-9)
    free = (share >= _UNBLENDED).nonzero()
    count = int(free[0]) if len(free) else longest
    blended = (gone - share[:, None, None] * whole)[:count].square().sum() < (gone - whole)[:count].square().sum()
    return torch.cat([torch.zeros(1).to(share), share[:count].clamp(0, 1)]) if blended else torch.zeros(1)


_MOST_SWAPPED = 4  # of a run: what differs for longer may be a turn of the body
_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
_LIMBS = ((("UpperLeg", "LowerLeg", "Foot", "Toes"),), (_ARM, _ARM[1:]))  # a tracker may know no shoulders
_OUTLIER = math.log(SHARE / ROTATIONS)
_SWAP_ROUNDS = 2


def exchange_swapped_limbs(
    motion: Motion, rigmap: RigMap, hidden: Bool[Tensor, "frames joints"]
) -> tuple[Motion, list[Artefact]]:
    """Return the motion with limbs exchanged back where left and right were swapped, and these frames as faults.

    Rotations are exchanged as those from the T-pose, or as they are in the file, whichever is likelier.
    """
    quats, faults = motion.local_quat_xyzw.clone(), []
    own, rigged, parents = motion.local_quat_xyzw, rigmap.joints, torch.tensor(motion.skeleton.parents)
    rests = (rigmap.rest_quat_xyzw.to(quats), quats.new_tensor([0, 0, 0, 1]).expand(quats.shape[1], 4))
    for limb in _LIMBS:
        found = []
        for parts in limb:
            pairs = [(rigged.get(f"left{part}"), rigged.get(f"right{part}")) for part in parts]
            known = [(left, right) for left, right in pairs if left is not None and right is not None]
            joints, partners = ([pair[k] for pair in known] + [pair[1 - k] for pair in known] for k in (0, 1))
            for rest in rests if known else ():
                # With rest R, a parent's P: a partner's rotation q' is P^-1 P' q' R'^-1 R in the joint's own frame.
                before = rotations.multiply(rotations.inverse(rest[parents[joints]]), rest[parents[partners]])
                after = rotations.multiply(rotations.inverse(rest[partners]), rest[joints])
                exchanged = rotations.multiply(rotations.multiply(before, own[:, partners]), after)
                runs = _find_swaps(own[:, joints], exchanged, ~hidden[:, joints])
                found += [(gain, start, stop, joints, exchanged) for gain, start, stop in runs]
        free = torch.ones(motion.num_frames, dtype=torch.bool)
        for _, start, stop, joints, exchanged in sorted(found, key=lambda run: -run[0]):
            if free[start:stop].all():
                free[start:stop] = False
                turns = rotations.turns_between(quats[start:stop, joints], exchanged[start:stop])
                degrees = math.degrees(float(turns.norm(dim=-1).max()))
                quats[start:stop, joints] = exchanged[start:stop]
                faults.append(Artefact(motion.skeleton.names[joints[0]], start, stop, "swap", degrees, "deg"))
    return (replace(motion, local_quat_xyzw=quats) if faults else motion), faults


def _find_swaps(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
) -> list[tuple[float, int, int]]:
    """Find runs of frames that are likelier exchanged, with the logarithm of how much likelier. Candidates lie between
    two frames from which on the exchanged rotations are nearer to the frame before."""
    same, other = ((1 - (each[1:] * captured[:-1]).sum(dim=-1).abs()).sum(dim=-1) for each in (captured, exchanged))
    turns = (other < same).nonzero()[:, 0].add(1).tolist()
    found = [(0.0, start, stop) for start in turns for stop in turns if 0 < stop - start <= _MOST_SWAPPED]
    prior = math.log(SHARE / len(captured))  # one clip in a hundred has one
    for _ in range(_SWAP_ROUNDS):  # what is likelier as captured is evidence for the rest
        if not found:
            break
        swapped = torch.zeros_like(seen[:, 0])
        for _, start, stop in found:
            swapped[start:stop] = True
        gains = _measure_gain(captured, exchanged, seen, swapped)
        gains = [(float(gains[start:stop].sum()) + prior, start, stop) for _, start, stop in found]
        found = [run for run in gains if run[0] > 0]
    return found


def _measure_gain(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
    swapped: Bool[Tensor, " frames"],
) -> Float[Tensor, " frames"]:
    """Return by how much the logarithm of the density of exchanged rotations is larger, given frames not swapped."""
    values = 2 * choose_continuous_signs(torch.where(swapped[:, None, None], exchanged, captured))
    values, centre = values - values.mean(dim=0), values.mean(dim=0)
    least = values.new_full((values.shape[1],), RESOLUTION)
    prediction = predict_frames(values, seen & ~swapped[:, None], least)
    densities = []
    for each in (exchanged, captured):
        errors = [(sign * 2 * each - centre - prediction.mean).norm(dim=-1) for sign in (1, -1)]
        likely = replace(prediction, error=torch.minimum(*errors)).log_density()
        densities.append(torch.logaddexp(likely, likely.new_tensor(_OUTLIER)))
    return (densities[0] - densities[1]).where(seen, 0.0).sum(dim=-1)
