"""A way that the hips are to go while nothing is known of them: along a curve, from one known place to the next."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals

_MAX_EDGE_DISTANCE = 1.0  # metres that a gap's edge may lie beside the curve


def move_root_along_curve(motion: Motion, lost: Bool[Tensor, " frames"], curve: Curve) -> Motion:
    """A canonical motion whose hips go and face along the curve in the frames in which they are lost, evenly fast.

    A gap's edges are where they are: the way goes over from the one edge's offset beside the curve to the other's.
    RequestError for a gap that begins or ends far from the curve.
    """
    if curve.dims != 2:
        raise RequestError("hips are led by a curve on the ground, of x and z")
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    facing = heading(quats[:, 0])
    for _, start, stop in true_intervals(lost[:, None]):
        edges = [frame for frame in (start - 1, stop) if 0 <= frame < motion.num_frames]
        if len(edges) == 1:
            raise RequestError(f"the gap {start}:{stop} has one edge only: a curve needs both")
        arcs = curve.nearest(root[edges][:, ::2])
        beside = root[edges][:, ::2] - curve.point(arcs)
        if (far := float(beside.norm(dim=-1).max())) > _MAX_EDGE_DISTANCE:
            raise RequestError(
                f"the gap {start}:{stop} begins or ends {far:.1f} m beside the curve;"
                f" {_MAX_EDGE_DISTANCE:g} m is the most"
            )
        share = (torch.arange(start, stop) - (start - 1)).double() / (stop - start + 1)
        first, last = arcs
        if curve.closed and last < first:
            last = last + curve.length
        at = first + share * (last - first)
        way = curve.point(at) + _interpolate_edges(beside, share)
        turns = _compute_curve_heading(curve, torch.stack([first, last])) - facing[edges]
        turn = _compute_curve_heading(curve, at) - _interpolate_edges(rotations.wrap_angle(turns)[:, None], share)[:, 0]
        root[start:stop, 0], root[start:stop, 2] = way[:, 0], way[:, 1]
        own = rotations.about_y(turn - heading(quats[start:stop, 0]))
        quats[start:stop, 0] = rotations.multiply(own, quats[start:stop, 0])
    return replace(motion, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))


def _interpolate_edges(
    ends: Float[Tensor, "2 width"], share: Float[Tensor, " frames"]
) -> Float[Tensor, "frames width"]:
    return torch.lerp(ends[0], ends[1], share[:, None])


def _compute_curve_heading(curve: Curve, arcs: Float[Tensor, " points"]) -> Float[Tensor, " points"]:
    """Heading of the curve, radians."""
    way = curve.tangent(arcs)
    return torch.atan2(way[..., 0], way[..., -1])
