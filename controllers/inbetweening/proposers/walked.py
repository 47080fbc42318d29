"""A walk over places that are all that is told: a density follows a curve through them in time (Wang et al. 2019,
section 5.2)."""

from dataclasses import dataclass, field, replace

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.following.follow import FollowSettings, walk_arcs
from mapctl import contacts, curves
from mapctl.curves import Curve
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.protocols import Density

_LEAST_WAY = 0.3  # metres from place to place, at the canonical size, that are walked and not stood


@dataclass(frozen=True, eq=False)
class WalkedPlaces:
    """A curve through places, and where on it somebody is in each frame."""

    curve: Curve
    """The curve, metres at the canonical size."""
    arcs: Float[Tensor, " ahead"]
    """Arcs of the frames and of a window beyond them, metres."""

    @staticmethod
    def of(query: GapQuery, fastest: float, ahead: int) -> "WalkedPlaces | None":
        """Lay a curve through the places of a query of which they are all that is told, from its first frame to its
        last; None where there are others, where somebody would stand, or be faster than `fastest`, m/s."""
        loose = query.loose
        if loose is None or not query.only_places:
            return None
        frames = loose.placed.nonzero()[:, 0]
        if len(frames) < 2 or int(frames[0]) > 0 or int(frames[-1]) < query.motion.num_frames - 1:
            return None
        places = loose.ground[frames].double() / query.scale
        ways = torch.diff(places, dim=0).norm(dim=-1)
        speeds = ways * PRIOR_FPS / torch.diff(frames)
        if float(ways.min()) < _LEAST_WAY or float(speeds.max()) > fastest:
            return None
        curve = curves.through(places)
        at = _find_arcs(curve, places)
        if float(torch.diff(at).min()) <= 0:
            return None
        timed = scipy.interpolate.PchipInterpolator(frames.numpy(), at.numpy())
        inside = torch.as_tensor(timed(torch.arange(int(frames[-1]) + 1).numpy()))
        speed = float(inside[-1] - inside[-2])
        beyond = inside[-1] + speed * torch.arange(1, ahead + 1)
        return WalkedPlaces(curve, torch.cat([inside, beyond]))


@dataclass(frozen=True)
class PlaceWalker:
    """Walks over places by one of several densities."""

    densities: tuple[Density, ...]
    """Densities; the first, that of locomotion, walks."""
    settings: FollowSettings = field(default_factory=FollowSettings)
    """Sigmas and search of following."""

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal | None:
        """Propose a walk; None where it is not one that the density knows (see `WalkedPlaces.of`)."""
        if not self.densities:
            return None
        density, ahead = self.densities[0], self.settings.window.frames
        walked = WalkedPlaces.of(query, density.limits.fastest, ahead)
        if walked is None:
            return None
        frames = query.motion.num_frames
        motion, done, _ = walk_arcs(
            density,
            walked.curve,
            walked.arcs,
            frames,
            character=Character(),
            settings=self.settings,
            generator=generator or torch.Generator().manual_seed(0),
        )
        body = replace(query.motion, root_position=motion.root_position, local_quat_xyzw=motion.local_quat_xyzw)
        root = body.root_position * query.scale
        source = f"walk of {density.name}"
        planted = done.features[:, LAYOUT.slices["contacts"]] > 0.5
        return Proposal(
            replace(body, root_position=root),
            contacts.to_logits(planted),
            source,
            (GapSource(0, frames, source, "along a curve through the places, which are all that keys tell"),),
        )


def _find_arcs(curve: Curve, places: Float[Tensor, "places 2"]) -> Float[Tensor, " places"]:
    """Find the arcs of the places that a curve leads through, metres."""
    dense = torch.linspace(0, curve.length, max(2, round(100 * curve.length)), dtype=torch.float64)
    points, found, first = curve.ground_point(dense), [], 0
    for place in places[:-1]:
        # A curve that crosses itself comes by twice.
        away = (points[first:] - place).norm(dim=-1)
        near = (away < float(away.min()) + 0.01).nonzero()[0, 0] if len(found) else away.argmin()
        first += int(near)
        found.append(float(dense[first]))
    return torch.tensor([*found, curve.length], dtype=torch.float64)
