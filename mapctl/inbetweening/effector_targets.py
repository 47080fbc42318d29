"""Target positions of effectors in frames that are otherwise free, and inverse kinematics that meets them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics import smooth_offsets
from mapctl.numerics.intervals import fill_missing, fill_missing_angle
from mapctl.skeleton import CANONICAL, LIMBS, TOE_REST_HEIGHT, Limb, Skeleton, leg_length

_MIN_REACH_SECONDS = 0.15  # seconds over which a limb goes to its target and back, at least
_REACH_ACCELERATION = 15.0  # m/s^2 at which it goes farther
_NEGLIGIBLE = 1e-12  # metres


@dataclass(frozen=True, eq=False)
class EffectorTargets:
    """Target positions, by frame and canonical joint; limbs bend to those of `LIMBS`."""

    positions: Float[Tensor, "frames joints 3"]
    """World positions, metres; anything finite where there is no target."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a joint has a target in a frame."""

    def shown(self, seconds: Float[Tensor, " shown"], *, fps: float) -> "EffectorTargets":
        """Return the targets at other, increasing times: each is moved to the time nearest to its own."""
        frame, joint = self.wanted.nonzero(as_tuple=True)
        nearest = _find_nearest_times(len(self.positions), seconds, fps=fps)[frame]
        positions, wanted = (values.new_zeros(len(seconds), *values.shape[1:]) for values in vars(self).values())
        positions[nearest, joint], wanted[nearest, joint] = self.positions[frame, joint], True
        return EffectorTargets(positions, wanted)


def _find_nearest_times(frames: int, seconds: Float[Tensor, " shown"], *, fps: float) -> Int[Tensor, " frames"]:
    """Find for each of so many frames which of other, increasing times is the nearest."""
    own = torch.arange(frames, dtype=seconds.dtype) / fps
    after = torch.searchsorted(seconds, own).clamp(max=len(seconds) - 1)
    before = (after - 1).clamp_min(0)
    return torch.where((seconds[before] - own).abs() <= (seconds[after] - own).abs(), before, after)


def compute_target_errors(
    positions: Float[Tensor, "frames joints 3"], targets: EffectorTargets
) -> Float[Tensor, " frames"]:
    """Compute the largest distance of a joint to its target, by frame, metres."""
    distances = (positions - targets.positions).norm(dim=-1)
    return (distances * targets.wanted).amax(dim=1)


def reach_effector_targets(motion: Motion, targets: EffectorTargets, free: Bool[Tensor, " frames"]) -> Motion:
    """Bend limbs of a canonical motion to their targets, if these are in reach; they go there and back smoothly within
    frames that are `free`."""
    for limb in LIMBS.values():
        wanted = targets.wanted[:, limb.end] & free
        if not bool(wanted.any()):
            continue
        ends = motion.joint_positions()[:, limb.end]
        errors = torch.where(wanted[:, None], targets.positions[:, limb.end] - ends, 0.0)
        seconds = max(_MIN_REACH_SECONDS, math.sqrt(float(errors.norm(dim=-1).max()) / _REACH_ACCELERATION))
        offset = smooth_offsets.interpolate_offsets(errors, wanted | ~free, seconds=seconds, fps=float(motion.fps))
        offset = torch.where(free[:, None], offset, 0.0)
        motion = bend_limb(motion, limb, ends + offset, offset.norm(dim=-1) > _NEGLIGIBLE)
    return motion


def bend_limb(motion: Motion, limb: Limb, ends: Float[Tensor, "frames 3"], frames: Bool[Tensor, " frames"]) -> Motion:
    """Bend a limb of a canonical motion in some frames so that its end is at `ends` (world, metres), as far as it
    reaches."""
    goals, free = motion.joint_positions().clone(), torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool)
    goals[:, limb.end] = torch.where(frames[:, None], ends, goals[:, limb.end])
    free[:, [limb.upper, limb.lower]] = frames[:, None]
    quats, root = motion.local_quat_xyzw, motion.root_position
    bent = inverse.solve_inverse_kinematics(goals, quats, motion.skeleton, free=free, limbs=(limb,), root_position=root)
    return replace(motion, local_quat_xyzw=torch.where(free[..., None], bent, quats))


_ANKLE_REST_HEIGHT = 0.1174
"""Height of the canonical ankles over the floor while the foot is flat on it, metres."""
_REST_HEIGHTS = {
    joint: _ANKLE_REST_HEIGHT if name.endswith("Foot") else TOE_REST_HEIGHT
    for joint, name in enumerate(CANONICAL.names)
    if name.endswith(("Foot", "Toes"))
}
_SAME_VIEW = math.radians(1.0)
_LEAST_LINE = 1e-3  # metres: a shorter line has no direction


@dataclass(frozen=True, eq=False)
class LooseKeys:
    """Ground positions and drawings, by frame."""

    placed: Bool[Tensor, " frames"]
    """Whether the hips' ground position is given by itself."""
    ground: Float[Tensor, "frames 2"]
    """That position (x, z), world, metres; anything finite where there is none."""
    drawn: Bool[Tensor, "frames joints"]
    """Whether a canonical joint is drawn."""
    sketch: Float[Tensor, "frames joints 2"]
    """Where it is drawn: to the viewer's right and up, in the drawing's own unit."""
    view: Float[Tensor, " frames"]
    """Heading from the body to the viewer, radians."""

    @staticmethod
    def none(frames: int, joints: int) -> "LooseKeys":
        """Return no key in any frame."""
        one, number = torch.bool, torch.float64
        return LooseKeys(
            torch.zeros(frames, dtype=one),
            torch.zeros(frames, 2, dtype=number),
            torch.zeros(frames, joints, dtype=one),
            torch.zeros(frames, joints, 2, dtype=number),
            torch.zeros(frames, dtype=number),
        )

    @property
    def drawings(self) -> Bool[Tensor, " frames"]:
        """Frames with a drawing."""
        return self.drawn.any(dim=1)

    def shown(self, seconds: Float[Tensor, " shown"], *, fps: float) -> "LooseKeys":
        """Return the keys at other, increasing times: each is moved to the time nearest to its own."""
        nearest = _find_nearest_times(len(self.placed), seconds, fps=fps)
        frames = (self.placed | self.drawings).nonzero()[:, 0]
        moved = LooseKeys.none(len(seconds), self.drawn.shape[1])
        for name, values in vars(moved).items():
            values[nearest[frames]] = getattr(self, name)[frames].to(values)
        return moved

    def scaled(self, factor: float) -> "LooseKeys":
        """Return the keys of a world that is so many times as large; drawings are of any size anyway."""
        return replace(self, ground=self.ground * factor)

    def see_from_one_side(self, skeleton: Skeleton) -> "SeenDrawings | None":
        """Return all drawings from the view of the first, for a body with these bones; None without any."""
        frames = self.drawings.nonzero()[:, 0].tolist()
        if not frames:
            return None
        positions = torch.zeros(*self.drawn.shape, 3, dtype=torch.float64)
        axes = torch.zeros(*self.drawn.shape, 3, dtype=torch.bool)
        view = float(self.view[frames[0]])
        for frame in frames:
            drawn = self.drawn[frame].nonzero()[:, 0].tolist()
            sketch = self.sketch[frame, drawn].double()
            sketch = _stand_at_origin(estimate_size(sketch, drawn, skeleton) * sketch, drawn, skeleton)
            cosine = math.cos(float(self.view[frame]) - view)
            # From elsewhere only heights look the same.
            flat = abs(cosine) > math.cos(_SAME_VIEW)
            positions[frame, drawn, :2] = sketch.new_tensor([math.copysign(1.0, cosine), 1.0]) * sketch
            axes[frame, drawn, 0], axes[frame, drawn, 1] = flat, True
        return SeenDrawings(positions, axes, view)


@dataclass(frozen=True, eq=False)
class SeenDrawings:
    """Drawings in metres, seen from one side."""

    positions: Float[Tensor, "frames joints 3"]
    """To the viewer's right from the hips, up from the floor, and 0."""
    known: Bool[Tensor, "frames joints 3"]
    """Which of these is drawn."""
    view: float
    """Heading from the body to the viewer, radians."""


def lead_over_positions(
    ground: Float[Tensor, "batch frames 2"],
    heading: Float[Tensor, "batch frames"],
    *,
    placed: Bool[Tensor, "batch frames"],
    faced: Bool[Tensor, "batch frames"],
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Lead ground (metres) and heading (radians) straight from one given position to the next, and from one given
    heading to the next. Where no heading of a motion is given it looks along its path: at a position between both lines
    that meet there, and from position to position evenly."""
    path = fill_missing(ground, placed)
    line = torch.nn.functional.normalize(torch.diff(path, dim=1), dim=-1)
    none = torch.zeros_like(path[:, :1])
    along = torch.cat([none, line], dim=1) + torch.cat([line, none], dim=1)
    moves = along.norm(dim=-1) > _LEAST_LINE
    looked = fill_missing_angle(torch.atan2(along[..., 0], along[..., 1]), placed & moves)
    looked = torch.where(moves.any(dim=1, keepdim=True), looked, 0.0)
    return path, torch.where(faced.any(dim=1, keepdim=True), fill_missing_angle(heading, faced), looked)


def view_axes(view: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 3"]:
    """Return the directions in the world that are drawn to the right and up, seen from these headings, radians."""
    zero, one = torch.zeros_like(view), torch.ones_like(view)
    right = rotations.rotate_about_y(torch.stack([one, zero, zero], dim=-1), view)
    return torch.stack([right, torch.stack([zero, one, zero], dim=-1)], dim=-2)


def estimate_size(sketch: Float[Tensor, "drawn 2"], joints: Sequence[int], skeleton: Skeleton) -> float:
    """Estimate the metres of a drawing's unit: the largest for which no two joints are drawn farther apart than the
    bones between them are long."""
    chains = _measure_chains(skeleton)[joints][:, joints]
    apart = torch.cdist(sketch, sketch)
    far = apart > 1e-9 * float(apart.max())
    return float((chains[far] / apart[far]).min())


def measure_floor(heights: Float[Tensor, " joints"], skeleton: Skeleton) -> float:
    """Measure the height of a floor on which the lowest foot of canonical joints would stand, metres; NaN heights are
    not known."""
    size = leg_length(skeleton) / leg_length(CANONICAL)
    floors = torch.stack([heights[joint] - size * rest for joint, rest in _REST_HEIGHTS.items()])
    floors = floors[torch.isfinite(floors)]
    return float(floors.min()) if len(floors) else math.nan


def estimate_standing_height(skeleton: Skeleton) -> float:
    """Estimate the hips' height of canonical joints that stand on both feet, metres."""
    return -measure_floor(_rest_heights(skeleton), skeleton)


def _stand_at_origin(
    sketch: Float[Tensor, "drawn 2"], joints: Sequence[int], skeleton: Skeleton
) -> Float[Tensor, "drawn 2"]:
    """Move a drawing, in metres, so that its hips are over the origin and its lowest foot is on the floor; where these
    are not drawn its middle is, and as high as it would be while standing upright."""
    middle = sketch[joints.index(0), 0] if 0 in joints else sketch[:, 0].mean()
    heights = torch.full((skeleton.num_joints,), torch.nan, dtype=sketch.dtype)
    heights[joints] = sketch[:, 1]
    floor = measure_floor(heights, skeleton)
    if math.isnan(floor):
        standing = _rest_heights(skeleton)[joints] + estimate_standing_height(skeleton)
        floor = float((sketch[:, 1] - standing).mean())
    return sketch - torch.stack([middle, middle.new_tensor(floor)])


def _rest_heights(skeleton: Skeleton) -> Float[Tensor, " joints"]:
    """Return the joints' heights over the hips in the T-pose, metres."""
    heights = [0.0]
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        heights.append(heights[parent] + float(skeleton.offsets[joint, 1]))
    return torch.tensor(heights, dtype=torch.float64)


def _measure_chains(skeleton: Skeleton) -> Float[Tensor, "joints joints"]:
    """Measure the bones between each two joints, metres."""
    lengths, on_chain = skeleton.offsets.norm(dim=-1), torch.zeros(skeleton.num_joints, skeleton.num_joints)
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        on_chain[joint] = on_chain[parent]
        on_chain[joint, joint] = 1.0
    return ((on_chain[:, None] - on_chain[None]).abs() * lengths).sum(dim=-1)
