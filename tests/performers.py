"""People of any bones who walk with feet that stand to the hair, by trigonometry and without the code under test."""

import math
from dataclasses import dataclass
from fractions import Fraction

import torch
from helpers import quat_xyzw
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton, leg_length

SIDES = ("left", "right")
HIPJOINTS, KNEES, FEET, TOES = (
    [CANONICAL.index(side + part) for side in SIDES] for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")
)
PERIOD, STANCE = 1.1, 0.6
"""Seconds of a stride, and the share of it in which a foot stands."""
_HEEL, _TOE = 0.6, -0.25  # radians that the foot points down as it leaves the floor, and up before it lands


@dataclass(frozen=True)
class Performer:
    """Rig of the bones."""

    size: float = 1.0
    """Size over that of the canonical body."""
    leg: float = 1.0
    """Length of the legs over that of the canonical body."""
    droop_deg: float = 0.0
    """By how much the feet of the T-pose point down."""
    toe_height: float = TOE_REST_HEIGHT
    """At which the toe joints stand, metres."""
    foot: tuple[float, float] = (-0.0749, 0.0906)
    """From ankle to toe joint while the foot is flat: up and forward, metres at size 1."""

    upright: float = 0.93
    """How far the hip joints are over the ankles of flat feet, of the legs' length."""
    sinks: float = 0.0
    """How far the toes go through the floor as the foot rolls over them, metres."""
    stair: float = 0.0
    """By how much each step is higher than the one before, metres."""
    thighs_drop: float = 0.0219
    """From the hips down to the hip joints, metres at size 1."""

    def walks(self, frames: int = 90, fps: int = 30) -> Motion:
        """A walk along +Z on canonical joints. Toe joints of standing feet do not move at all; each rolls over its
        toes before it leaves the floor, and comes down flat."""
        bones = self._bones()
        root, ankles, pitch = self._plan(bones, torch.arange(frames, dtype=torch.float64) / fps)
        local = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(frames, CANONICAL.num_joints, 1)
        for k in range(2):
            thigh, knee = _leg_angles(ankles[:, k] - root - bones.offsets[HIPJOINTS[k]], bones, k)
            # What the T-pose has down is turned up in the foot's joint, and its toes lie as they did.
            foot = pitch[:, k] - thigh - knee - math.radians(self.droop_deg)
            angles = {HIPJOINTS[k]: thigh, KNEES[k]: knee, FEET[k]: foot, TOES[k]: -pitch[:, k]}
            for joint, angle in angles.items():
                local[:, joint] = _about_x(angle)
        return Motion(bones, Fraction(fps), root, local)

    def stands(self, frames: int = 60, fps: int = 30, *, turned: dict[int, Tensor] | None = None) -> Motion:
        """Straight, on flat feet, with further turns about x (radians, one a frame) in some joints."""
        bones = self._bones()
        root = torch.zeros(frames, 3, dtype=torch.float64)
        root[:, 1] = self.toe_height - self.size * self.foot[0] + leg_length(bones) - bones.offsets[HIPJOINTS[0], 1]
        local = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(frames, CANONICAL.num_joints, 1)
        for foot in FEET:
            local[:, foot] = _about_x(torch.full((frames,), -math.radians(self.droop_deg)))
        for joint, angle in (turned or {}).items():
            local[:, joint] = rotations.multiply(local[:, joint], _about_x(angle))
        return Motion(bones, Fraction(fps), root, local)

    def body(self) -> RiggedCharacter:
        """As the walk shows it."""
        return RiggedCharacter.of(self.walks())[1]

    def _bones(self) -> Skeleton:
        offsets = CANONICAL.offsets * self.size
        offsets[[*KNEES, *FEET]] *= self.leg
        offsets[HIPJOINTS, 1] = -self.size * self.thighs_drop
        down = _about_x(torch.deg2rad(torch.tensor([self.droop_deg], dtype=torch.float64)))
        offsets[TOES] = rotations.rotate(down, self.size * torch.tensor([[0.0, *self.foot]], dtype=torch.float64))
        return Skeleton(CANONICAL.names, CANONICAL.parents, offsets)

    def _plan(self, bones: Skeleton, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where hips and ankles are, and how far each foot points down (radians)."""
        frames, leg = len(time), leg_length(bones)
        stride = 1.3 * leg
        root, ankles, pitches = torch.zeros(frames, 3).double(), torch.zeros(frames, 2, 3).double(), []
        flat = self.size * torch.tensor([0.0, *self.foot], dtype=torch.float64)
        root[:, 2] = stride * time / PERIOD
        root[:, 1] = self.toe_height - flat[1] + self.upright * leg - bones.offsets[HIPJOINTS[0], 1]
        root[:, 1] += self.stair * (2 * time / PERIOD + 0.2)
        for k in range(2):
            phase = time / PERIOD + 0.5 * k
            step, share = phase.floor(), phase.remainder(1.0)
            swing = ((share - STANCE) / (1 - STANCE)).clamp(0, 1)
            rolled = _smooth(((share - 0.4) / (STANCE - 0.4)).clamp(0, 1))
            pitch = _HEEL * rolled * (1 - _smooth(swing)) + _TOE * torch.sin(torch.pi * swing) ** 2 * swing
            toes = torch.zeros(frames, 3).double()
            toes[:, 0] = bones.offsets[HIPJOINTS[k], 0]
            toes[:, 1] = self.toe_height + 0.12 * leg * torch.sin(torch.pi * swing) ** 2
            toes[:, 1] += self.stair * (2 * (step + _smooth((1.6 * swing).clamp(max=1))) + 1 - k)
            toes[:, 1] -= self.sinks * rolled * (1 - _smooth(swing))
            toes[:, 2] = stride * (step + _smooth(swing) - 0.5 * k + STANCE / 2) + flat[2]
            ankles[:, k] = toes - rotations.rotate(_about_x(pitch), flat.expand(frames, 3))
            pitches.append(pitch)
        return root, ankles, torch.stack(pitches, dim=1)


def _leg_angles(
    way: Float[Tensor, "frames 3"], bones: Skeleton, k: int
) -> tuple[Float[Tensor, " frames"], Float[Tensor, " frames"]]:
    """Turns about x of thigh and knee that bring the ankle so far from the hip joint (cosine rule)."""
    upper, lower = (float(bones.offsets[joints[k]].norm()) for joints in (KNEES, FEET))
    far = way.norm(dim=-1).clamp(max=0.9999 * (upper + lower))
    bend = torch.pi - torch.acos((upper**2 + lower**2 - far**2) / (2 * upper * lower))
    ahead = torch.atan2(way[:, 2], -way[:, 1])
    inner = torch.acos(((upper**2 + far**2 - lower**2) / (2 * upper * far)).clamp(-1, 1))
    return -(ahead + inner), bend


def _about_x(angle: Float[Tensor, " count"]) -> Float[Tensor, "count 4"]:
    return quat_xyzw(torch.stack([angle, 0 * angle, 0 * angle], dim=-1).double())


def _smooth(way: Tensor) -> Tensor:
    return way**3 * (10 + way * (6 * way - 15))
