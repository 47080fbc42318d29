"""Poses that look as drawn from one side: rotations of joints about a proposed pose, fitted so that drawn joints come
to be where they are drawn.

How large a drawing is shows in its bones, none of which looks longer than it is; which way a limb leads from the viewer
or to him does not show, and is as the proposed pose has it.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import joint_ranges, rotations
from mapctl.inbetweening.loose_keys import LooseKeys, estimate_size, measure_floor, view_axes
from mapctl.kinematics import forward_kinematics, heading
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton
from mapctl.solver import lbfgs
from mapctl.solver.lbfgs import LbfgsSettings


@dataclass(frozen=True)
class FitSettings:
    """Sigmas and search of the fit."""

    sigma_drawn: float = 0.005
    """Distance of a joint from where it is drawn, metres."""
    sigma_pose_deg: float = 25.0
    """Turn of a joint from the proposed pose, degrees."""
    sigma_tilt_deg: float = 15.0
    """Tilt of the hips from the proposed pose, degrees."""
    sigma_range_deg: float = 3.0
    """Turn of a joint beyond its range, degrees."""
    sigma_size: float = 0.03
    """Share by which a drawing is larger than its bones let it be."""
    turns: int = 8
    """Headings, evenly around, from which the search sets out."""
    sigma_heading_deg: float = 45.0
    """Turn from the proposed heading, degrees, by which among these answers is chosen where keys tell a heading."""
    lbfgs: LbfgsSettings = field(
        default_factory=lambda: LbfgsSettings(max_iterations=80, relative_energy_tolerance=1e-5)
    )
    """Search from each of them."""


def fit_drawings(motion: Motion, loose: LooseKeys, *, faced: bool, settings: FitSettings | None = None) -> Motion:
    """Turn the joints of a canonical motion, in frames with drawings, until they look as drawn; `faced` says whether
    its headings are more than a guess. The lower foot then stands on the floor."""
    settings, frames = settings or FitSettings(), loose.drawings.nonzero()[:, 0]
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    for frame in frames.tolist():
        fitted = _fit(motion.skeleton, quats[frame], _View.of(loose, frame, motion.skeleton), faced, settings)
        quats[frame] = fitted
        root[frame, 1] = -measure_floor(_place_joints(motion.skeleton, fitted)[:, 1], motion.skeleton)
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def measure_drawing_error(places: Float[Tensor, "joints 3"], loose: LooseKeys, frame: int) -> float:
    """Measure how far drawn joints are on average from where they are drawn, metres, the drawing moved and scaled to
    the best fit, and all as large as the body is in space: one that folds up to look small is no nearer for it."""
    drawn = loose.drawn[frame]
    seen = places[drawn].double() @ view_axes(loose.view[frame]).double().mT
    sketch = loose.sketch[frame, drawn].double()
    seen, sketch = seen - seen.mean(dim=0), sketch - sketch.mean(dim=0)
    scale = (seen * sketch).sum() / sketch.square().sum().clamp_min(1e-12)
    body = places[drawn].double()
    size = (body - body.mean(dim=0)).norm() / seen.norm().clamp_min(1e-12)
    return float(size * (seen - scale * sketch).norm(dim=-1).mean())


@dataclass(frozen=True, eq=False)
class _View:
    """One drawing, as it is fitted."""

    joints: list[int]
    """Canonical joints that are drawn."""
    target: Float[Tensor, "drawn 2"]
    """Where, about their mean, metres by the estimated size."""
    axes: Float[Tensor, "2 3"]
    """Directions to the right and up."""

    @staticmethod
    def of(loose: LooseKeys, frame: int, skeleton: Skeleton) -> "_View":
        joints = loose.drawn[frame].nonzero()[:, 0].tolist()
        sketch = loose.sketch[frame, joints].double()
        target = estimate_size(sketch, joints, skeleton) * sketch
        return _View(joints, target - target.mean(dim=0), view_axes(loose.view[frame]).double())


def _fit(
    skeleton: Skeleton, made: Float[Tensor, "joints 4"], view: _View, faced: bool, settings: FitSettings
) -> Float[Tensor, "joints 4"]:
    """Fit one pose, from several headings at once, and return the best."""
    count, joints = settings.turns, len(made)
    turns = torch.arange(count, dtype=made.dtype) * (2 * math.pi / count)
    start = made.expand(count, -1, -1).clone()
    start[:, 0] = rotations.multiply(rotations.about_y(turns), start[:, 0])
    unknowns = torch.zeros(count, 3 * joints + 1, dtype=made.dtype)
    ranges = joint_ranges.load()
    own = ranges.find_excess(ranges.to_angles(rotations.to_matrix(made[1:])))

    def energies(rows: Tensor) -> Tensor:
        turn, size = rows[:, :-1].unflatten(1, (joints, 3)), rows[:, -1]
        quats = rotations.multiply(start, rotations.from_rotation_vector(turn))
        seen = _place_joints(skeleton, quats)[:, view.joints] @ view.axes.mT
        off = seen - seen.mean(dim=1, keepdim=True) - (settings.sigma_size * size).exp()[:, None, None] * view.target
        angles = ranges.to_angles(rotations.to_matrix(quats[:, 1:]))
        beyond = (ranges.find_excess(angles) - own).clamp_min(0)
        return 0.5 * (
            (off / settings.sigma_drawn).square().sum(dim=(1, 2))
            + (torch.rad2deg(turn[:, 1:]) / settings.sigma_pose_deg).square().sum(dim=(1, 2))
            + (_tilt_deg(start[:, 0], quats[:, 0]) / settings.sigma_tilt_deg).square()
            + (torch.rad2deg(beyond) / settings.sigma_range_deg).square().sum(dim=(1, 2))
            + size.square()
        )

    def differentiate(points: Tensor) -> tuple[Tensor, Tensor]:
        rows = points.detach().requires_grad_(True)
        with torch.enable_grad():
            energy = energies(rows)
            (gradient,) = torch.autograd.grad(energy.sum(), rows)
        return energy.detach(), gradient

    found = lbfgs.minimise(differentiate, unknowns, settings=settings.lbfgs)
    turn = found.x[:, :-1].unflatten(1, (joints, 3))
    quats = rotations.multiply(start, rotations.from_rotation_vector(turn))
    away = torch.rad2deg(rotations.wrap_angle(heading(quats[:, 0]) - heading(made[:1])))
    energy = found.energy + (0.5 * (away / settings.sigma_heading_deg).square() if faced else 0.0)
    return quats[int(energy.argmin())]


def _place_joints(skeleton: Skeleton, quats: Float[Tensor, "*batch joints 4"]) -> Float[Tensor, "*batch joints 3"]:
    """Place joints about the hips."""
    root = torch.zeros(*quats.shape[:-2], 3, dtype=quats.dtype)
    return forward_kinematics(skeleton.offsets.to(quats), skeleton.parents, root, quats)[0]


def _tilt_deg(one: Float[Tensor, "batch 4"], other: Float[Tensor, "batch 4"]) -> Float[Tensor, " batch"]:
    """Return by how much the body's axis leans otherwise, as a chord, degrees."""
    up = one.new_tensor([0.0, 1.0, 0.0]).expand(len(one), 3)
    # A body seen from itself: what is up for it tells its lean without its heading.
    lean = rotations.rotate(rotations.inverse(one), up) - rotations.rotate(rotations.inverse(other), up)
    return torch.rad2deg((lean.square().sum(dim=-1) + 1e-12).sqrt())
