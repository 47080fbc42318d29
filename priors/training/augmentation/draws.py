"""What all augmentations draw with: random numbers for a batch of windows, stretches of frames, and joints that go
together.
"""

import math

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mapctl.skeleton import CANONICAL

LIMBS = tuple(
    tuple(CANONICAL.index(name) for name in names)
    for names in (
        ("leftShoulder", "leftUpperArm", "leftLowerArm", "leftHand"),
        ("leftUpperArm", "leftLowerArm", "leftHand"),
        ("rightShoulder", "rightUpperArm", "rightLowerArm", "rightHand"),
        ("rightUpperArm", "rightLowerArm", "rightHand"),
        ("leftLowerArm", "leftHand"),
        ("rightLowerArm", "rightHand"),
        ("leftUpperLeg", "leftLowerLeg", "leftFoot", "leftToes"),
        ("leftFoot", "leftToes"),
        ("rightUpperLeg", "rightLowerLeg", "rightFoot", "rightToes"),
        ("rightFoot", "rightToes"),
        ("neck", "head"),
        ("spine", "chest"),
    )
)
"""Joints that are lost together."""


class Draws:
    """Random numbers of one generator, for a batch of windows."""

    def __init__(self, generator: torch.Generator, batch: int, frames: int):
        self.generator, self.batch, self.frames = generator, batch, frames

    def uniform(self, *shape: int) -> Tensor:
        """(batch, *shape), from 0 to 1."""
        return torch.rand(self.batch, *shape, generator=self.generator)

    def normal(self, *shape: int) -> Tensor:
        """(batch, *shape), of unit variance."""
        return torch.randn(self.batch, *shape, generator=self.generator)

    def log_uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """(batch, *shape), their logarithms evenly between the bounds'."""
        return low * torch.exp(self.uniform(*shape) * math.log(high / low))

    def below(self, bound: Int[Tensor, " batch"]) -> Int[Tensor, " batch"]:
        """Whole numbers from 0 up to each bound, exclusive."""
        return (self.uniform() * bound).long().minimum(bound - 1)

    def limb(self) -> Bool[Tensor, "batch joints"]:
        """The joints of one of `LIMBS`."""
        limbs = torch.zeros(len(LIMBS), CANONICAL.num_joints, dtype=torch.bool)
        for row, joints in enumerate(LIMBS):
            limbs[row, list(joints)] = True
        return limbs[self.below(torch.full((self.batch,), len(LIMBS)))]

    def joints(self, limbs: float) -> Bool[Tensor, "batch joints"]:
        """1 to 3 joints at random, or in this share of cases those of a limb."""
        limb, order = self.limb(), self.uniform(CANONICAL.num_joints).argsort(dim=1).argsort(dim=1)
        some = order < (1 + self.uniform(1) * 3).floor()
        return torch.where(self.uniform(1) < 1 - limbs, some, limb)

    def mark(self, start: Tensor, length: Tensor) -> Bool[Tensor, "batch frames"]:
        """True from each start on for so many frames."""
        frame = torch.arange(self.frames)
        return (frame >= start[:, None]) & (frame < (start + length)[:, None])
