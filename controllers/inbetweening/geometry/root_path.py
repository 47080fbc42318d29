"""Trajectory of the hips while their position is missing: along a curve from one known position to the next, or
straight over places that are told by themselves."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.inbetweening.loose_keys import LooseKeys, estimate_standing_height, lead_over_places
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals

_MAX_EDGE_DISTANCE = 1.0  # metres from a gap's edge to the curve


def move_root_along_curve(motion: Motion, missing: Bool[Tensor, " frames"], curve: Curve) -> Motion:
    """Move and orient the hips of a canonical motion along the curve, at constant speed, in frames in which they are
    missing.

    The offset from the curve is interpolated from one edge of a gap to the other. RequestError for a gap that begins or
    ends far from the curve.
    """
    if curve.dims != 2:
        raise RequestError("the hips follow a curve on the ground, of x and z")
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    facing = heading(quats[:, 0])
    for _, start, stop in true_intervals(missing[:, None]):
        edges = [frame for frame in (start - 1, stop) if 0 <= frame < motion.num_frames]
        if len(edges) == 1:
            raise RequestError(f"the gap {start}:{stop} has one edge only: a curve needs both")
        arcs = curve.nearest(root[edges][:, ::2])
        offsets = root[edges][:, ::2] - curve.point(arcs)
        if (far := float(offsets.norm(dim=-1).max())) > _MAX_EDGE_DISTANCE:
            raise RequestError(
                f"the gap {start}:{stop} begins or ends {far:.1f} m beside the curve;"
                f" {_MAX_EDGE_DISTANCE:g} m is the most"
            )
        share = (torch.arange(start, stop) - (start - 1)).double() / (stop - start + 1)
        first, last = arcs
        if curve.closed and last < first:
            last = last + curve.length
        at = first + share * (last - first)
        position = curve.point(at) + _interpolate_edges(offsets, share)
        turns = curve.heading(torch.stack([first, last])) - facing[edges]
        turn = curve.heading(at) - _interpolate_edges(rotations.wrap_angle(turns)[:, None], share)[:, 0]
        root[start:stop, 0], root[start:stop, 2] = position[:, 0], position[:, 1]
        own = rotations.about_y(turn - heading(quats[start:stop, 0]))
        quats[start:stop, 0] = rotations.multiply(own, quats[start:stop, 0])
    return replace(motion, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))


def _interpolate_edges(
    ends: Float[Tensor, "2 width"], share: Float[Tensor, " frames"]
) -> Float[Tensor, "frames width"]:
    return torch.lerp(ends[0], ends[1], share[:, None])


def move_root_over_places(
    motion: Motion, missing_root: Bool[Tensor, " frames"], missing_hips: Bool[Tensor, " frames"], loose: LooseKeys
) -> Motion:
    """Move the hips of a canonical motion over the places of loose keys where their position is missing, and turn them
    along that way where no frame tells their rotation. At a height that no frame tells they stand."""
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    ground = torch.where(loose.placed[:, None], loose.ground, root[:, ::2])
    facing = heading(quats[:, 0])
    way, looked = lead_over_places(
        ground[None], facing[None], placed=(loose.placed | ~missing_root)[None], faced=~missing_hips[None]
    )
    root[:, ::2] = torch.where(missing_root[:, None], way[0], root[:, ::2])
    if bool(missing_root.all()):
        root[:, 1] = estimate_standing_height(motion.skeleton)
    turn = torch.where(missing_hips, looked[0] - facing, 0.0)
    quats[:, 0] = rotations.multiply(rotations.about_y(turn), quats[:, 0])
    return replace(motion, root_position=root, local_quat_xyzw=quats)
