"""Motion: a skeleton moving through time. Immutable; every operation returns a new one."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from importlib import import_module
from os import PathLike

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.arguments import read_number
from mapctl.errors import MapctlError, RequestError
from mapctl.skeleton import Skeleton, mirror_name

_MOST_ROTATIONS = 50_000_000  # of a resampled motion: some gigabytes while they are interpolated
_CHORD_SECONDS = 0.5  # between the frames whose distances are added up: sway and noise count little


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """Frames of one skeleton, float64, metres, Y up."""

    skeleton: Skeleton
    """Skeleton of the joints."""
    fps: Fraction
    """Frames per second, exact."""
    root_position: Float[Tensor, "frames 3"]
    """Position of joint 0 in the world, metres."""
    local_quat_xyzw: Float[Tensor, "frames joints 4"]
    """Rotation of each joint in its parent's frame, xyzw."""
    moving_offsets: Mapping[int, Float[Tensor, "frames 3"]] = field(default_factory=dict)
    """Joints below the root whose offset is animated, as Hips under a static root; metres."""
    source: object | None = None
    """Layout that a format needs to write the file back as it came (channels, unit); formats define it."""
    licence: str = ""
    """Licence under which it may be used, with what it comes from, where that is known; some formats keep it."""

    def __post_init__(self):
        frames, joints = self.root_position.shape[0], self.skeleton.num_joints
        if self.root_position.shape != (frames, 3) or self.local_quat_xyzw.shape != (frames, joints, 4):
            shapes = f"{tuple(self.root_position.shape)} and {tuple(self.local_quat_xyzw.shape)}"
            raise MapctlError(f"a motion of {joints} joints needs (frames, 3) and (frames, {joints}, 4), got {shapes}")
        if frames == 0 or self.fps <= 0:
            raise MapctlError("a motion needs at least one frame and a positive frame rate")

    @staticmethod
    def at_rest(skeleton: Skeleton) -> "Motion":
        """Return one frame with all rotations zero and the root at the origin."""
        still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(1, skeleton.num_joints, 1)
        return Motion(skeleton, Fraction(30), torch.zeros(1, 3, dtype=torch.float64), still)

    def __str__(self) -> str:
        return f"Motion: {self.describe()}"

    def __repr__(self) -> str:
        return f"<{self}>"

    def describe(self) -> str:
        """Describe frames, rate, duration, joints, and the distance travelled in chords of half a second, in one
        line."""
        frames, joints = _count(self.num_frames, "frame"), _count(self.num_joints, "joint")
        step = max(1, round(_CHORD_SECONDS * float(self.fps)))
        picked = self._map_frames(lambda values: torch.cat([values[:-1:step], values[-1:]]))
        travelled = picked.joint_positions()[:, self.travelling_joint].diff(dim=0).norm(dim=-1).sum()
        seconds = f"{self.seconds:.1f}" if self.seconds >= 1 else f"{self.seconds:.2g}"
        return f"{frames} at {float(self.fps):.5g} fps ({seconds} s), {joints}, travels {float(travelled):.1f} m"

    @property
    def num_frames(self) -> int:
        """How many frames there are."""
        return self.root_position.shape[0]

    @property
    def num_joints(self) -> int:
        """How many joints the skeleton has."""
        return self.skeleton.num_joints

    @property
    def seconds(self) -> float:
        """Duration: frames over frame rate."""
        return float(self.num_frames / self.fps)

    @property
    def travelling_joint(self) -> int:
        """Index of the joint whose position is that of the body: the root, or the first below a root that stays
        still."""
        moving = [joint for joint, values in self.moving_offsets.items() if bool((values != values[0]).any())]
        stays = bool((self.root_position == self.root_position[0]).all())
        return min(moving) if stays and moving else 0

    @cached_property
    def _world(self) -> tuple[Tensor, Tensor]:
        offsets = self.skeleton.offsets
        if self.moving_offsets:
            offsets = offsets.expand(self.num_frames, -1, -1).clone()
            for joint, values in self.moving_offsets.items():
                offsets[:, joint] = values
        return kinematics.forward_kinematics(offsets, self.skeleton.parents, self.root_position, self.local_quat_xyzw)

    def joint_positions(self) -> Float[Tensor, "frames joints 3"]:
        """Return the world positions in metres, joints in file order."""
        return self._world[0]

    def joint_rotations(self) -> Float[Tensor, "frames joints 4"]:
        """Return the world rotations (xyzw), joints in file order."""
        return self._world[1]

    def slice(self, start: int, stop: int) -> "Motion":
        """Return frames start to stop (half-open); RequestError if they are not all there."""
        if not 0 <= start < stop <= self.num_frames:
            raise RequestError(f"frames {start}:{stop} are not within 0:{self.num_frames}")
        return self._map_frames(lambda values: values[start:stop])

    def pick(self, frames: Int[Tensor, " picked"]) -> "Motion":
        """Return some frames, in that order; a frame may be named more than once."""
        return self._map_frames(lambda values: values[frames])

    def reverse(self) -> "Motion":
        """Return the motion backward in time."""
        return self._map_frames(lambda values: values.flip(0))

    def join(self, other: "Motion") -> "Motion":
        """Join this motion and `other`, which must have the same skeleton and frame rate; nothing is moved."""
        if not self.skeleton.matches(other.skeleton) or self.fps != other.fps:
            raise MapctlError("only motions of one skeleton and frame rate can be joined")
        travelling = sorted({*self.moving_offsets, *other.moving_offsets})
        moving = {j: torch.cat([self._offset(j), other._offset(j)]) for j in travelling}
        root = torch.cat([self.root_position, other.root_position])
        return replace(
            self,
            root_position=root,
            moving_offsets=moving,
            licence=join_licences((self.licence, other.licence)),
            local_quat_xyzw=torch.cat([self.local_quat_xyzw, other.local_quat_xyzw]),
        )

    def resample(self, fps: Fraction | float) -> "Motion":
        """Resample the motion to another frame rate: positions linear, rotations slerp; the first frame stays.

        Going down, a short moving average would blur contacts, so frames are interpolated, not filtered. RequestError
        for a rate that needs more memory than a machine has.
        """
        exact = fps if isinstance(fps, Fraction) else Fraction(read_number(fps, "the frame rate"))
        fps = exact.limit_denominator(100_000)
        if fps <= 0:
            raise RequestError(f"the frame rate must be positive, got {float(exact):g}")
        if fps == self.fps:
            return self
        count = int((self.num_frames - 1) * fps / self.fps) + 1
        if count > self.num_frames and count * self.num_joints > _MOST_ROTATIONS:
            raise RequestError(f"a frame rate of {float(fps):g} would give {count} frames, too many for memory")
        return replace(self.sample(torch.arange(count, dtype=torch.float64) * float(self.fps / fps)), fps=fps)

    def sample(self, frames: Float[Tensor, " sampled"]) -> "Motion":
        """Return the poses at these frames or between them (2.5 is halfway from frame 2 to 3): positions linear,
        rotations slerp. Before the first frame and after the last one the motion stands still."""
        at = frames.clamp(0, self.num_frames - 1)
        low = at.floor().long()
        high, weight = (low + 1).clamp(max=self.num_frames - 1), (at - low).unsqueeze(-1)

        def linear(values: Tensor) -> Tensor:
            return torch.lerp(values[low], values[high], weight)

        quat = self.local_quat_xyzw
        return replace(
            self,
            root_position=linear(self.root_position),
            local_quat_xyzw=rotations.slerp(quat[low], quat[high], weight.expand(-1, self.num_joints)),
            moving_offsets={j: linear(v) for j, v in self.moving_offsets.items()},
        )

    def mirror(self) -> "Motion":
        """Exchange left and right through the plane x = 0; for canonical joint frames and names.

        Bones are exchanged too. Raises MapctlError where a side's joint has no partner, or sides are named otherwise.
        """
        names = self.skeleton.names
        swap = self.skeleton.mirror_partners()
        flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
        # A reflection through x = 0 keeps rotation about x and reverses rotation about y and z.
        flip_quat = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
        ends = {mirror_name(n): (-x, y, z) for n, (x, y, z) in self.skeleton.end_offsets.items()}
        skeleton = Skeleton(names, self.skeleton.parents, self.skeleton.offsets[swap] * flip, ends)
        moving = {swap[j]: v * flip for j, v in self.moving_offsets.items()}
        return replace(
            self,
            skeleton=skeleton,
            root_position=self.root_position * flip,
            moving_offsets=moving,
            local_quat_xyzw=self.local_quat_xyzw[:, swap] * flip_quat,
            source=None,
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the motion in the format that the path's ending names."""
        import_module("mapctl.formats").save(self, path)

    def _offset(self, joint: int) -> Float[Tensor, "frames 3"]:
        """Return a joint's offset in every frame, animated or not."""
        return self.moving_offsets.get(joint, self.skeleton.offsets[joint].expand(self.num_frames, 3))

    def _map_frames(self, pick) -> "Motion":
        moving = {j: pick(v) for j, v in self.moving_offsets.items()}
        return replace(
            self,
            root_position=pick(self.root_position),
            moving_offsets=moving,
            local_quat_xyzw=pick(self.local_quat_xyzw),
        )


def _count(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def join_licences(licences: Iterable[str]) -> str:
    """Join licences into one text, each once; empty ones are left out."""
    return "; ".join(dict.fromkeys(filter(None, licences)))
