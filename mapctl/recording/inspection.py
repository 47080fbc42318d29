"""Inspection of a recording: which joints leap or stand still when they should not, and how noisy the rest is.

Limbs whose left and right are exchanged for a few frames, as a tracker that mistakes its labels leaves them.

A run of frames is exchanged back where the frames beside it predict the exchanged rotations rather than those captured:
the Bayes factor of both, of all joints of the two limbs together (Kass and Raftery 1995). A rotation that neither
explains may be an outlier, so that no single joint decides.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, last_observed, true_intervals
from mapctl.recording.faults import (
    BODY,
    ROTATIONS,
    SHARE,
    find_angle_spikes,
    find_held_frames,
    find_position_spikes,
    predict_frames,
)
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks
from mapctl.recording.noise_estimation import (
    RESOLUTION,
    choose_continuous_signs,
    estimate_angle_noise,
    estimate_position_noise,
)
from mapctl.retarget import RigMap

NOISE_DEG, NOISE_CM = 0.5, 0.2
"""Least noise that is listed, degrees and centimetres: optical capture has as much."""
_SKATE_SPEED = 0.2  # m/s that a planted toe moves by, over some frames, before it is said to slide
_FLOAT_HEIGHT = 0.03  # metres that it is above its support
_MIN_FRAMES = 3  # frames of either


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
    """noise, spike, dropout, frozen, slide, float, swap: left and right limb exchanged, or stretch: an offset of a bone
    that varies only by noise."""
    amount: float
    """Noise's sigma, height of a spike or of a floating toe, distance of a slide, largest error of an offset, largest
    turn of a swap; 0 for a dropout and frozen frames."""
    unit: str
    """Unit of the amount."""


def list_noise(
    names: Sequence[str], angles: Float[Tensor, " joints"], root: float, *, travels: int, frames: int
) -> list[Artefact]:
    """List joints whose angles are noisy (radians), and the position of the travelling joint (metres)."""
    degrees = torch.rad2deg(angles).tolist()
    found = [
        Artefact(name, 0, frames, "noise", amount, "deg")
        for name, amount in zip(names, degrees, strict=True)
        if amount >= NOISE_DEG
    ]
    if 100 * root >= NOISE_CM:
        found.append(Artefact(names[travels], 0, frames, "noise", 100 * root, "cm"))
    return found


def list_spikes(
    names: Sequence[str], spikes: Bool[Tensor, "frames joints"], away: Float[Tensor, "frames joints"], unit: str
) -> list[Artefact]:
    """List spikes, and how far each is from what replaced it."""
    return [
        Artefact(names[joint], start, stop, "spike", float(away[start:stop, joint].max()), unit)
        for joint, start, stop in true_intervals(spikes)
    ]


def list_dropouts(names: Sequence[str], dropouts: Bool[Tensor, "frames joints"]) -> list[Artefact]:
    """List where joints were not observed."""
    return [Artefact(names[joint], start, stop, "dropout", 0.0, "") for joint, start, stop in true_intervals(dropouts)]


def list_foot_artefacts(
    names: Sequence[str],
    toes: Float[Tensor, "frames 2 3"],
    planted: Bool[Tensor, "frames 2"],
    *,
    rest_height: Float[Tensor, "frames 2"],
    fps: float,
) -> list[Artefact]:
    """List planted toes that slide, and planted toes over the height that they rest at; world positions, metres, at any
    rate."""
    steps = torch.diff(toes[..., ::2], dim=0, prepend=toes[:1, :, ::2]).norm(dim=-1)
    slides = planted & (steps * fps > _SKATE_SPEED)
    height = toes[..., 1] - rest_height
    floats = planted & (height > _FLOAT_HEIGHT)
    found = [
        Artefact(names[foot], start, stop, "slide", 100 * float(steps[start:stop, foot].sum()), "cm")
        for foot, start, stop in true_intervals(slides)
        if stop - start >= _MIN_FRAMES
    ]
    return found + [
        Artefact(names[foot], start, stop, "float", 100 * float(height[start:stop, foot].max()), "cm")
        for foot, start, stop in true_intervals(floats)
        if stop - start >= _MIN_FRAMES
    ]


_LOCKED_CHANGE = 1e-6  # of a quaternion, that rounding leaves of a joint which never moves


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording on its own rig, with masks of its artefacts."""

    motion: Motion
    """The recording, unchanged."""
    spikes: Bool[Tensor, "frames joints"]
    """Whether a joint's rotation is a spike."""
    dropouts: Bool[Tensor, "frames joints"]
    """Whether a joint is masked, or stands perfectly still though it moves otherwise."""
    spikes_root: Bool[Tensor, " frames"]
    """Whether the root's position is a spike."""
    dropouts_root: Bool[Tensor, " frames"]
    """Whether the root's position is masked."""
    noise: Float[Tensor, " joints"]
    """Noise sigma of each of a joint's three angles, radians."""
    noise_root: float
    """Noise sigma of each coordinate of the root, metres."""
    travels: int
    """Index of the joint that travels: the root, or the one below it that is moved instead."""
    frozen: Bool[Tensor, " frames"]
    """Whether the whole body is held, or zero, while it moves; all joints are dropouts there."""
    faults: tuple[Artefact, ...] = ()
    """Faults of the whole body, with their kinds."""

    @property
    def seen(self) -> Bool[Tensor, "frames joints"]:
        """Observation mask of rotations: neither spike nor missing."""
        return ~(self.spikes | self.dropouts)

    @cached_property
    def locked(self) -> Bool[Tensor, " joints"]:
        """Whether a joint's rotation is the same wherever it is observed: it is known where it is not, too."""
        quats = self.motion.local_quat_xyzw
        held = _hold_last_observed(quats, self.seen)
        still = (quats - held[:1]).norm(dim=-1) < _LOCKED_CHANGE
        return (still | ~self.seen).all(dim=0) & self.seen.any(dim=0)

    @property
    def known(self) -> Bool[Tensor, "frames joints"]:
        """Mask of rotations that are observed, or need not be, since the joint is locked."""
        return self.seen | self.locked

    @property
    def lost(self) -> Bool[Tensor, "frames joints"]:
        """Mask of rotations that are missing, of joints that move."""
        return self.dropouts & ~self.locked

    @property
    def seen_root(self) -> Bool[Tensor, " frames"]:
        """Observation mask of the root's position: neither spike nor missing."""
        return ~(self.spikes_root | self.dropouts_root)

    def place(self, motion: Motion) -> Float[Tensor, "frames 3"]:
        """Return the position of the travelling joint in a motion of this rig, metres."""
        return motion.moving_offsets[self.travels] if self.travels else motion.root_position

    def slice(self, start: int, stop: int) -> "Inspection":
        """Return frames start to stop; the noise stays that of the whole."""
        part = slice(start, stop)
        return replace(
            self,
            motion=self.motion.slice(start, stop),
            spikes=self.spikes[part],
            dropouts=self.dropouts[part],
            spikes_root=self.spikes_root[part],
            dropouts_root=self.dropouts_root[part],
            frozen=self.frozen[part],
        )

    def repaired(self) -> Motion:
        """Return the recording with artefacts filled in, interpolated from the frames around them."""
        motion, seen = self.motion, self.seen
        quats = choose_continuous_signs(_hold_last_observed(motion.local_quat_xyzw, seen))
        steps = fill_missing(quats.transpose(0, 1), seen.T).transpose(0, 1)
        root = fill_missing(motion.root_position[None], self.seen_root[None])[0]
        moving = {
            joint: fill_missing(values[None], self.seen_root[None])[0] if joint == self.travels else values
            for joint, values in motion.moving_offsets.items()
        }
        return replace(
            motion,
            root_position=root,
            moving_offsets=moving,
            local_quat_xyzw=torch.nn.functional.normalize(steps, dim=-1),
        )


def inspect_recording(motion: Motion, masks: Sequence[Mask] = ()) -> Inspection:
    """Look over a recording on any rig; RequestError for masks that name joints or frames it has not."""
    quats = choose_continuous_signs(motion.local_quat_xyzw)
    hidden, hidden_root = expand_valid_masks(motion, masks)
    travels = motion.travelling_joint
    place = motion.moving_offsets[travels] if travels else motion.root_position
    spikes, spikes_root = find_angle_spikes(quats, ~hidden), find_position_spikes(place, ~hidden_root)
    held, frozen = _find_held_frames(quats, place, hidden | spikes, hidden_root | spikes_root)
    dropouts, dropouts_root = hidden | held[:, :-1] | frozen[:, None], hidden_root | frozen
    # What is found to be false explains no other frame.
    spikes, spikes_root = find_angle_spikes(quats, ~dropouts), find_position_spikes(place, ~dropouts_root)
    # Each spike corrupts the differences of the frames around it.
    noise = estimate_angle_noise(quats, ~(dropouts | spikes))
    noise_root = estimate_position_noise(place, ~(dropouts_root | spikes_root))
    faults = tuple(Artefact(ALL, start, stop, "frozen", 0.0, "") for _, start, stop in true_intervals(frozen[:, None]))
    return Inspection(motion, spikes, dropouts, spikes_root, dropouts_root, noise, noise_root, travels, frozen, faults)


def _find_held_frames(
    quats: Float[Tensor, "frames joints 4"],
    place: Float[Tensor, "frames 3"],
    hidden: Bool[Tensor, "frames joints"],
    hidden_root: Bool[Tensor, " frames"],
) -> tuple[Bool[Tensor, "frames tracks"], Bool[Tensor, " frames"]]:
    """Find held and zero frames of the joints, and of the position as the last track."""
    position = torch.nn.functional.pad(place, (0, 1))[:, None]
    values = torch.cat([2 * quats, position], dim=1)
    volumes = quats.new_tensor([ROTATIONS] * quats.shape[1] + [BODY])
    moving = (quats != quats[:1]).any(dim=-1).any(dim=0)
    zero = (quats[:, moving, :3] == 0).all(dim=-1).all(dim=-1) & moving.any()
    return find_held_frames(values, torch.cat([hidden, hidden_root[:, None]], dim=1), zero, RESOLUTION, volumes)


def _hold_last_observed(quats: Tensor, seen: Tensor) -> Tensor:
    """Hold the last observed rotation where nothing is observed: signs are then chosen between frames that count."""
    nearest = last_observed(seen.T).T
    return torch.take_along_dim(quats, nearest[..., None], dim=0)


def find_gaps(motion: Motion) -> tuple[Mask, ...]:
    """Find the gaps of a motion that no mask gives; RequestError if there are none."""
    examined = inspect_recording(motion)
    frozen, names = examined.frozen, motion.skeleton.names
    masks = [Mask(ALL, start, stop) for _, start, stop in true_intervals(frozen[:, None])]
    wrong = ~examined.seen & ~frozen[:, None]
    masks += [Mask(names[joint], start, stop) for joint, start, stop in true_intervals(wrong)]
    lost = ~examined.seen_root & ~frozen
    masks += [Mask(ROOT, start, stop) for _, start, stop in true_intervals(lost[:, None])]
    if not masks:
        raise RequestError(
            "no frame is frozen and none leaps: say which frames are missing (--gap A:B) or which joints"
        )
    return tuple(masks)


_MOST_FRAMES = 4  # of a run: what differs for longer may be a turn of the body
_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
_LIMBS = ((("UpperLeg", "LowerLeg", "Foot", "Toes"),), (_ARM, _ARM[1:]))  # a tracker may know no shoulders
_OUTLIER = math.log(SHARE / ROTATIONS)
_ROUNDS = 2


def exchange_swapped_limbs(
    motion: Motion, rigmap: RigMap, hidden: Bool[Tensor, "frames joints"]
) -> tuple[Motion, tuple[Artefact, ...]]:
    """Return the motion with limbs exchanged back where left and right were swapped, and these frames as faults.

    Rotations are exchanged as those from the T-pose, or as they are in the file, whichever is likelier.
    """
    quats, faults = motion.local_quat_xyzw.clone(), []
    rests = (rigmap.rest_quat_xyzw.to(quats), quats.new_tensor([0, 0, 0, 1]).expand(quats.shape[1], 4))
    for limb in _LIMBS:
        found = []
        for joints, partners in _list_pairs(rigmap, limb):
            for rest in rests:
                exchanged = _exchange(motion, rest, joints, partners)
                runs = _find_swaps(motion.local_quat_xyzw[:, joints], exchanged, ~hidden[:, joints])
                found += [(gain, start, stop, joints, exchanged) for gain, start, stop in runs]
        free = torch.ones(motion.num_frames, dtype=torch.bool)
        for _, start, stop, joints, exchanged in sorted(found, key=lambda run: -run[0]):
            if free[start:stop].all():
                free[start:stop] = False
                turn = rotations.multiply(rotations.inverse(quats[start:stop, joints]), exchanged[start:stop])
                degrees = math.degrees(float(rotations.to_rotation_vector(turn).norm(dim=-1).max()))
                quats[start:stop, joints] = exchanged[start:stop]
                faults.append(Artefact(motion.skeleton.names[joints[0]], start, stop, "swap", degrees, "deg"))
    return (replace(motion, local_quat_xyzw=quats) if faults else motion), tuple(faults)


def _list_pairs(rigmap: RigMap, limb: Sequence[Sequence[str]]) -> Iterator[tuple[list[int], list[int]]]:
    """List a limb's joints on the rig, left and right, and the partner of each."""
    rigged = rigmap.joints
    for parts in limb:
        pairs = [(rigged.get(f"left{part}"), rigged.get(f"right{part}")) for part in parts]
        known = [(left, right) for left, right in pairs if left is not None and right is not None]
        if known:
            left, right = (list(side) for side in zip(*known, strict=True))
            yield left + right, right + left


def _exchange(
    motion: Motion, rest: Float[Tensor, "joints 4"], joints: list[int], partners: list[int]
) -> Float[Tensor, "frames limb 4"]:
    """Return the partners' rotations from the rest pose, in the joints' own frames: with rest R, a parent's P, a
    partner's rotation q' is P^-1 P' q' R'^-1 R."""
    parents = torch.tensor(motion.skeleton.parents)
    quats = motion.local_quat_xyzw[:, partners]
    before = rotations.multiply(rotations.inverse(rest[parents[joints]]), rest[parents[partners]])
    after = rotations.multiply(rotations.inverse(rest[partners]), rest[joints])
    return rotations.multiply(rotations.multiply(before.expand_as(quats), quats), after.expand_as(quats))


def _find_swaps(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
) -> list[tuple[float, int, int]]:
    """Find runs of frames that are likelier exchanged, with the logarithm of how much likelier.

    Candidates lie between two frames from which on the exchanged rotations are nearer to the frame before.
    """
    same, other = ((1 - (each[1:] * captured[:-1]).sum(dim=-1).abs()).sum(dim=-1) for each in (captured, exchanged))
    turns = (other < same).nonzero()[:, 0].add(1).tolist()
    found = [(0.0, start, stop) for start in turns for stop in turns if 0 < stop - start <= _MOST_FRAMES]
    prior = math.log(SHARE / len(captured))  # one clip in a hundred has one
    for _ in range(_ROUNDS):  # what is likelier as captured is evidence for the rest
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
