"""Inspection of a recording: which joints leap or stand still when they should not, and how noisy the rest is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, last_observed
from mapctl.recording.masks import Mask, expand_valid_masks
from mapctl.recording.noise_estimation import estimate_angle_noise, estimate_position_noise
from mapctl.recording.quaternion_signs import choose_continuous_signs
from mapctl.recording.spike_detection import find_angle_spikes, find_position_spikes

_LOCKED_CHANGE = 1e-6  # of a quaternion, that rounding leaves of a joint which never moves
_FROZEN_SECONDS = 0.1  # that a joint which moves otherwise does not move at all


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
        )

    def with_locked_joints(self) -> Motion:
        """Return the recording, its locked joints as they are elsewhere in frames in which they are not observed."""
        motion = self.motion
        held = _hold_last_observed(motion.local_quat_xyzw, self.seen)
        return replace(motion, local_quat_xyzw=torch.where(self.locked[:, None], held, motion.local_quat_xyzw))

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
    frozen = _find_frozen_joints(quats, hidden, float(motion.fps))
    dropouts, dropouts_root = hidden | frozen, hidden_root
    noise, noise_root = estimate_angle_noise(quats, ~dropouts), estimate_position_noise(place, ~dropouts_root)
    spikes = find_angle_spikes(quats, noise) & ~dropouts
    spikes_root = find_position_spikes(place, noise_root) & ~dropouts_root
    # Each spike corrupts the differences of the frames around it.
    noise = estimate_angle_noise(quats, ~(dropouts | spikes))
    noise_root = estimate_position_noise(place, ~(dropouts_root | spikes_root))
    return Inspection(motion, spikes, dropouts, spikes_root, dropouts_root, noise, noise_root, travels)


def _find_frozen_joints(
    quats: Float[Tensor, "frames joints 4"], hidden: Bool[Tensor, "frames joints"], fps: float
) -> Bool[Tensor, "frames joints"]:
    """Find runs in which nothing of a joint's rotation changes, not even by rounding, of joints that move most of the
    time that they are not hidden.

    A whole body that stands still is a paused recording, or a stand: it is left alone.
    """
    still = (quats[1:] == quats[:-1]).all(dim=-1)
    if len(still) == 0:
        return torch.zeros(quats.shape[:2], dtype=torch.bool)
    told = ~(hidden[1:] | hidden[:-1])
    moves = (~still & told).sum(dim=0) > 0.5 * told.sum(dim=0)
    still = still & moves & (still.double().mean(dim=1, keepdim=True) < 0.8)
    shortest = max(2, round(_FROZEN_SECONDS * fps))
    if len(still) < shortest:
        return torch.zeros(quats.shape[:2], dtype=torch.bool)
    whole = still.T.unfold(-1, shortest, 1).all(dim=-1)
    spread = torch.nn.functional.pad(whole, (shortest - 1, shortest - 1)).unfold(-1, shortest, 1).any(dim=-1).T
    # The frame before the run is the last that was true.
    return torch.cat([torch.zeros_like(spread[:1]), spread])


def _hold_last_observed(quats: Tensor, seen: Tensor) -> Tensor:
    """Hold the last observed rotation where nothing is observed: signs are then chosen between frames that count."""
    nearest = last_observed(seen.T).T
    return torch.take_along_dim(quats, nearest[..., None], dim=0)
