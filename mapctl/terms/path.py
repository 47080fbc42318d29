"""Follow a curve: sideways distance and progress along the arc (rnn paper, Eq. 17, whose nearest point has no speed).

Hips sway about the path a walker follows; a term that pulled every frame onto the curve would put them on rails. So the
slow part of the sideways offset is held tightly and the raw offset loosely.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.trial import Trial


@dataclass(frozen=True, eq=False)
class Path:
    """The chosen joint stays on the curve and is at the wanted arc at the wanted time."""

    curve: Curve
    """On the ground, or in space for a joint's own path."""
    arcs: Float[Tensor, " frames"]
    """Wanted arc of each frame of the window, metres."""
    joint: str = "hips"
    """Which joint follows."""
    sigma_slow: float = 0.015
    """Of the sideways offset after a Gaussian of `slow_seconds`, metres."""
    sigma_raw: float = 0.08
    """Of the sideways offset itself, metres."""
    sigma_progress: float = 0.08
    """Of the arc that is missing or too much, metres."""
    sigma_height: float = 0.03
    """Of the height over a curve in space, metres."""
    slow_seconds: float = 0.35
    """Standard deviation of the Gaussian that separates the slow offset from the sway."""
    name: str = "path"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats of sideways offset, its slow part, progress, and height in space."""
        places = self._places(trial)
        arcs = self._nearest(places)
        sideways = self.curve.signed_offset(places, arcs)
        energy = 0.5 * (sideways / self.sigma_raw).square()
        energy = energy + 0.5 * (self._slow(trial, sideways) / self.sigma_slow).square()
        energy = energy + 0.5 * (self._missing(places, arcs) / self.sigma_progress).square()
        if self.curve.dims == 3:
            energy = energy + 0.5 * (self._height(places, arcs) / self.sigma_height).square()
        return energy

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Distance to the curve, metres."""
        places = self._places(trial)
        at = self.curve.point(self._nearest(places))
        return (self._flat(places) - at).norm(dim=-1)

    def _places(self, trial: Trial) -> Float[Tensor, "batch frames 3"]:
        if self.joint == "hips" and self.curve.dims == 2:  # no need of the whole body's kinematics
            ground = trial.root_xz_world
            return torch.stack([ground[..., 0], torch.zeros_like(ground[..., 0]), ground[..., 1]], dim=-1)
        return trial.joint_world(self.joint)

    def _nearest(self, places: Tensor) -> Tensor:
        with torch.no_grad():
            around = self.arcs.to(places.dtype).expand(places.shape[:-1])
            return self.curve.nearest(places, around=around, reach=0.6)

    def _missing(self, places: Tensor, arcs: Tensor) -> Tensor:
        along = ((self._flat(places) - self.curve.point(arcs)) * self.curve.tangent(arcs)).sum(-1)
        return arcs - self.arcs.to(places.dtype) + along

    def _height(self, places: Tensor, arcs: Tensor) -> Tensor:
        """Over the curve in space; the arc is held in the gradient, so what lies along a slope is taken off here."""
        apart, tangent = places - self.curve.point(arcs), self.curve.tangent(arcs)
        return apart[..., 1] - (apart * tangent).sum(-1) * tangent[..., 1]

    def _flat(self, places: Tensor) -> Tensor:
        return places[..., ::2] if self.curve.dims == 2 else places

    def _slow(self, trial: Trial, sideways: Tensor) -> Tensor:
        """The offset smoothed over time; the frames before the window count, missing ones do not."""
        past = trial.before[:, trial.skeleton.index(self.joint)].to(sideways.dtype)
        frames, reach = sideways.shape[-1], round(3 * self.slow_seconds * trial.fps)
        past = past[-reach:]
        if len(past):
            step = (self.arcs[1] - self.arcs[0]) if frames > 1 else 0.0
            around = self.arcs[0] - step * torch.arange(len(past), 0, -1)
            before = self.curve.signed_offset(past, self.curve.nearest(past, around=around, reach=0.6))
            sideways = torch.cat([before.expand(*sideways.shape[:-1], -1), sideways], dim=-1)
        weights = gaussian_weights(sideways.shape[-1], self.slow_seconds * trial.fps, sideways.dtype)
        return sideways @ weights[-frames:].T


def gaussian_weights(count: int, sigma_frames: float, dtype: torch.dtype) -> Float[Tensor, "count count"]:
    """Row t averages the frames around t with a Gaussian, normalised over the frames there are."""
    at = torch.arange(count, dtype=dtype)
    weights = torch.exp(-0.5 * ((at[:, None] - at[None]) / sigma_frames).square())
    return weights / weights.sum(-1, keepdim=True)
