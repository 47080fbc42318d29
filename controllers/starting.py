"""Choose the moment of mocap that a motion begins from, and how it stands on the curve."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.features import LAYOUT, Place, decode, root_places
from mapctl.rotations import wrap_angle
from mapctl.skeleton import Skeleton
from mapctl.solver.objective import Objective
from mapctl.solver.variables import Context, Latents
from mapctl.solver.window import Committed
from mapctl.terms import Term

_CANDIDATES = 24
_AMONG_BEST = 6
_LOOK_AHEAD = 34


@dataclass(frozen=True, eq=False)
class Start:
    """Where a motion begins."""

    committed: Committed
    """The first frame, as the window solver wants it."""
    before_first: Place
    """The place from which `features.decode` leads to the first frame."""
    notes: tuple[str, ...] = ()
    """What the user should know."""


def choose_start(
    prior: Any, curve: Curve, arcs: Float[Tensor, " frames"], terms_of: Callable[[int, int], Sequence[Term]], *,
    skeleton: Skeleton, fps: float, generator: torch.Generator,
) -> Start:  # fmt: skip
    """Of the prior's starts near the wanted speed, one of those whose plain rollout fits the wishes best.

    Each candidate stands on the curve's first point and is turned so that the rollout's first half second goes along
    the curve. The generator picks among the best few, so that seeds give different walks.
    """
    wanted = float(arcs[1] - arcs[0]) * fps
    ahead = min(_LOOK_AHEAD, len(arcs) - 1)
    near = (prior.starts.speed - wanted).abs().argsort()[:_CANDIDATES]
    state = prior.starts.state.pick(near)
    noise = torch.zeros(len(near), ahead, LAYOUT.continuous)
    features, _ = prior.rollout(state, noise, prior.plan(state, noise))
    places = Place(_first_point(curve).expand(len(near), 2), _aligned_heading(features, curve, arcs))
    context = Context(prior, state, places, torch.zeros(0, skeleton.num_joints, 3), ahead, skeleton, fps)
    flat = noise.flatten(1)
    with torch.no_grad():
        energy = Objective(Latents.planned(context, flat).build, terms_of(1, ahead)).energy(flat)
    best = energy.argsort()[:_AMONG_BEST]
    pick = int(best[torch.randint(len(best), (1,), generator=generator)])
    place = Place(places.position_xz[pick], places.heading[pick])
    return _standing(state.pick(torch.tensor([pick])), place, skeleton, ())


def _standing(state: Any, place: Place, skeleton: Skeleton, notes: tuple[str, ...]) -> Start:
    first = state.previous
    before = place.before(
        LAYOUT.pick(first[0], "root_displacement_heading"), LAYOUT.pick(first[0], "heading_change")[0]
    )
    joints = decode(first, before, skeleton=skeleton).joint_positions().to(first.dtype)
    return Start(Committed(state, place, first, joints, first.new_zeros(0, LAYOUT.continuous)), before, notes)


def _first_point(curve: Curve) -> Float[Tensor, "2"]:
    return curve.point(0.0)[..., :: curve.dims - 1].float()


def _aligned_heading(features: Tensor, curve: Curve, arcs: Tensor) -> Float[Tensor, " starts"]:
    """Heading of each start's frame that makes the rollout's way over the first half second parallel to the curve's."""
    half = features.shape[1] // 2
    ground, _ = root_places(features, Place.origin())
    way = curve.point(arcs[half]) - curve.point(0.0)
    wanted = torch.atan2(way[0], way[-1]).float()
    walked = torch.atan2(ground[:, half - 1, 0], ground[:, half - 1, 1])
    return wrap_angle(wanted - walked)
