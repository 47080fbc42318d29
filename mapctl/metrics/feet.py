"""Foot measures: skate, contact speed, planted share, penetration and float of toes; speed and slide of heels.

The floor is the clip's own: the 5th percentile of each toe's height.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.contacts import derive_heel_contacts
from mapctl.motion import Motion
from mapctl.retarget.character import level_feet
from mapctl.skeleton import FEET, TOES, find_heel_drops, find_heels

SKATE_REACH = 0.025
"""Height over the floor below which a moving toe skates, metres."""


@dataclass(frozen=True, eq=False)
class ToeMeasurements:
    """Toe joints of a clip with the inputs of every foot measure."""

    height: Float[Tensor, "frames feet"]
    """Height over the floor, metres, all frames."""
    speed: Float[Tensor, "steps feet"]
    """Speed over the ground from the frame before, m/s, all frames but the first."""
    planted: Bool[Tensor, "frames feet"]
    """Contacts by `contacts.detect_contacts`, all frames."""

    @staticmethod
    def of(toe_positions: Float[Tensor, "frames feet 3"], fps: float) -> "ToeMeasurements":
        """Measure toe positions in metres."""
        height = toe_positions[..., 1] - contacts.estimate_floor_heights(toe_positions)
        speed = toe_positions[..., ::2].diff(dim=0).norm(dim=-1) * fps
        return ToeMeasurements(height, speed, contacts.detect_contacts(toe_positions, fps))


def skate(toes: ToeMeasurements) -> float:
    """Return the mean over frames and toes of speed (2 - 2^(h / 2.5 cm)) where the height h is under 2.5 cm; m/s."""
    height = toes.height[1:]
    weight = torch.where(height < SKATE_REACH, 2 - torch.exp2(height.clamp(0, SKATE_REACH) / SKATE_REACH), 0.0)
    return float((toes.speed * weight).mean())


def skate_ratio(toes: ToeMeasurements) -> float:
    """Return the share of toe-frames under 5 cm, at both ends of the step, that move faster than 0.2 m/s."""
    low = toes.height < 0.05
    return float((low[1:] & low[:-1] & (toes.speed > 0.2)).double().mean())


def contact_speed(toes: ToeMeasurements) -> float:
    """Return the mean speed of planted toes over the ground, m/s; NaN if none is ever planted."""
    return float(toes.speed[toes.planted[1:]].mean())


def planted_share(toes: ToeMeasurements) -> float:
    """Return the share of toe-frames that are planted."""
    return float(toes.planted[1:].double().mean())


def penetration(toes: ToeMeasurements) -> float:
    """Return the mean depth of planted toes under the floor, metres; NaN if none is ever planted."""
    return float((-toes.height[toes.planted]).clamp_min(0).mean())


def float_height(toes: ToeMeasurements) -> float:
    """Return the mean height of planted toes over the floor, metres; NaN if none is ever planted."""
    return float(toes.height[toes.planted].clamp_min(0).mean())


def locate_heels(motion: Motion) -> Float[Tensor, "frames 2 3"]:
    """Locate the left and the right heel of a motion of canonical joints whose foot frames are aligned with the world
    while feet are flat: world positions, metres (see `skeleton.find_heels`)."""
    feet, offsets = motion.skeleton.indices(FEET), find_heels(motion.skeleton)
    turned = rotations.rotate(motion.joint_rotations()[:, feet], offsets.expand(motion.num_frames, 2, 3))
    return motion.joint_positions()[:, feet] + turned


@dataclass(frozen=True, eq=False)
class HeelMeasurements:
    """Heels of a clip with the inputs of their measures."""

    ground: Float[Tensor, "frames 2 2"]
    """Place over the ground, metres."""
    yaw: Float[Tensor, "frames 2"]
    """Direction from heel to toe about +Y, radians, not wrapped."""
    planted: Bool[Tensor, "frames 2"]
    """Contacts by `contacts.heels.derive_heel_contacts`."""
    fps: float
    """Frames a second."""

    @staticmethod
    def of(motion: Motion) -> "HeelMeasurements":
        """Measure a motion of canonical joints; how its feet lie flat is told by the clip."""
        toes, heels, planted = _derive_heels(motion)
        forward = toes - heels
        yaw = rotations.unwrap_angle(torch.atan2(forward[..., 0], forward[..., 2]).T).T
        return HeelMeasurements(heels[..., ::2], yaw, planted, float(motion.fps))

    @property
    def _stays(self) -> Bool[Tensor, "steps 2"]:
        return self.planted[1:] & self.planted[:-1]

    def contact_speed(self) -> float:
        """Return the mean speed of planted heels over the ground, m/s; NaN if none is planted in two frames."""
        return float((self.ground.diff(dim=0).norm(dim=-1) * self.fps)[self._stays].mean())

    def planted_share(self) -> float:
        """Return the share of heel-frames that are planted."""
        return float(self.planted[1:].double().mean())

    def largest_slide(self) -> float:
        """Return how far a heel gets at most from where it was planted, within one contact, metres; NaN if none is
        planted."""
        start, slides = self.ground[0], []
        for frame in range(len(self.ground)):
            lands = ~self.planted[frame - 1] if frame else torch.ones_like(self.planted[0])
            start = torch.where(lands[:, None], self.ground[frame], start)
            slides.append((self.ground[frame] - start).norm(dim=-1))
        held = torch.stack(slides)[self.planted]
        return float(held.max()) if len(held) else float("nan")

    def turn_rate(self) -> float:
        """Return the mean rate at which feet turn about the vertical while toe and heel are planted, rad/s; NaN if none
        is."""
        return float((self.yaw.diff(dim=0).abs() * self.fps)[self._stays].mean())


def _derive_heels(
    motion: Motion,
) -> tuple[Float[Tensor, "frames 2 3"], Float[Tensor, "frames 2 3"], Bool[Tensor, "frames 2"]]:
    """Toes and heels in the world, metres, and whether each heel is planted."""
    level, fps = level_feet(motion), float(motion.fps)
    toes, heels = level.joint_positions()[:, level.skeleton.indices(TOES)], locate_heels(level)
    drops = heels.new_tensor(find_heel_drops(level.skeleton))
    return toes, heels, derive_heel_contacts(contacts.detect_contacts(toes, fps), toes, heels, drops, fps)
