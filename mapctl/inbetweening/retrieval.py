"""Retrieval: the nearest window of a collection of motion by both ends, bent to meet them; needs no training."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL


@dataclass(frozen=True, eq=False)
class MotionCollection:
    """Clips of one body on canonical joints at PRIOR_FPS, one after the other."""

    motions: tuple[Motion, ...]
    """The clips."""
    positions: Float[Tensor, "frames joints 3"]
    """World joint positions, metres, float32."""
    heading: Float[Tensor, " frames"]
    """Heading of the hips, radians."""

    @staticmethod
    def of(motions: Sequence[Motion]) -> "MotionCollection":
        """Collect clips."""
        positions = torch.cat([motion.joint_positions().float() for motion in motions])
        facing = torch.cat([heading(motion.local_quat_xyzw[:, 0]).float() for motion in motions])
        return MotionCollection(tuple(motions), positions, facing)

    def find_nearest(
        self, first: Motion, last: Motion, steps: int, count: int = 1, *, within: float = torch.inf
    ) -> list[Motion]:
        """Return windows of so many steps whose first and last poses, seen from its first hips, are nearest to these
        two poses (motions of one frame) in the mean square over joints: the nearest of each of `count` clips, those
        not farther than `within`, metres, root mean square. ValueError if no clip is long enough.
        """
        starts, clip, ends = _see_ends(self, steps)
        if not len(starts):
            raise ValueError(f"no clip has {steps + 1} frames")
        wanted = torch.cat([first.joint_positions(), last.joint_positions()]).float()
        facing = heading(first.local_quat_xyzw[:, 0]).float()
        target = _see_from(wanted[None], wanted[:1, 0], facing).flatten()
        # A part at a time, as differences of all windows at once would not fit into the processor's cache.
        square = torch.cat([(part - target).square().sum(dim=1) for part in ends.split(5000)])
        least = torch.full((len(self.motions),), torch.inf).scatter_reduce(0, clip, square, "amin")
        joints, firsts, windows = wanted.shape[0] * wanted.shape[1], self.firsts, []
        for number in least.argsort(stable=True)[:count].tolist():
            if not (bool(least[number].isfinite()) and float(least[number]) <= joints * within**2):
                break
            nearest = int(starts[torch.where(clip == number, square, torch.inf).argmin()]) - int(firsts[number])
            windows.append(self.motions[number].slice(nearest, nearest + steps + 1))
        return windows

    @property
    def firsts(self) -> Int[Tensor, " clips"]:
        """First frame of each clip."""
        lengths = torch.tensor([motion.num_frames for motion in self.motions])
        return lengths.cumsum(0) - lengths

    def find_starts(self, steps: int) -> Int[Tensor, " windows"]:
        """Return the first frames of all windows of so many steps."""
        starts, first = [], 0
        for motion in self.motions:
            starts.append(torch.arange(first, first + max(0, motion.num_frames - steps)))
            first += motion.num_frames
        return torch.cat(starts)


# Of one length, as every gap of a length asks for it in turn: of the training clips, and of those with the gap.
@lru_cache(maxsize=2)
def _see_ends(
    collection: MotionCollection, steps: int
) -> tuple[Int[Tensor, " windows"], Int[Tensor, " windows"], Float[Tensor, "windows columns"]]:
    """Return the first frames of all windows, the numbers of their clips, and both ends' joint positions seen from the
    first hips."""
    starts = collection.find_starts(steps)
    clip = torch.searchsorted(collection.firsts, starts, right=True) - 1
    ends = torch.stack([collection.positions[starts], collection.positions[starts + steps]], dim=1)
    return starts, clip, _see_from(ends, collection.positions[starts, 0], collection.heading[starts]).flatten(1)


def bend_to_ends(motion: Motion, first: Motion, last: Motion) -> Motion:
    """Move and turn a motion onto its first pose's place, and spread what then differs at both ends over it linearly:
    rotations along the shortest arc, the hips' place in the world.
    """
    turn = heading(first.local_quat_xyzw[:, 0]) - heading(motion.local_quat_xyzw[:1, 0])
    about = rotations.about_y(turn)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(about.expand(len(quats), -1), quats[:, 0])
    offset = motion.root_position - motion.root_position[:1]
    root = rotations.rotate_about_y(offset, turn) + first.root_position
    weight = torch.linspace(0, 1, motion.num_frames, dtype=root.dtype)
    ends = torch.stack([first.local_quat_xyzw[0], last.local_quat_xyzw[0]])
    change = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[[0, -1]]), ends))
    spread = change[0] + (change[1] - change[0]) * weight[:, None, None]
    quats = rotations.multiply(quats, rotations.from_rotation_vector(spread))
    miss = torch.cat([first.root_position, last.root_position]) - root[[0, -1]]
    root = root + miss[0] + (miss[1] - miss[0]) * weight[:, None]
    return replace(motion, root_position=root, local_quat_xyzw=quats, skeleton=CANONICAL)


def _see_from(
    positions: Float[Tensor, "windows poses joints 3"],
    origin: Float[Tensor, "windows 3"],
    facing: Float[Tensor, " windows"],
) -> Tensor:
    """Return positions seen from the ground under an origin, along a heading."""
    ground = rotations.lift_ground(origin[..., ::2])[:, None, None]
    return rotations.rotate_about_y(positions - ground, -facing[:, None, None])
