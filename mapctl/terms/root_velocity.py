"""Travel: speed and direction over the ground, and which way the body faces (rnn paper, section 5.3, Eq. 20-23).

The paper wants the mean speed of a window and the direction of its last frame. Speed rises and falls within a stride
and hips sway, so here the slow part of the velocity is held, frame by frame: a window may then hold a change of both.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.numerics import gaussian
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class RootVelocity:
    """The hips' slow velocity over the ground is the wanted one, and the body faces a wanted way."""

    velocities: Float[Tensor, "frames 2"]
    """Wanted in each frame of the window: x and z of the world, m/s; zero is to stand."""
    velocities_before: Float[Tensor, "past 2"]
    """Wanted in the frames before the window, oldest first; what was missed there is still owed."""
    facing: Float[Tensor, " frames"] | None = None
    """Wanted heading of the hips in each frame, radians about +Y; None leaves it to the prior."""
    sigma_speed: float = 0.1
    """Of the slow velocity along the wanted one, m/s."""
    sigma_direction: float = 0.1
    """Of the slow velocity across the wanted one, as an angle, radians."""
    sigma_facing: float = 0.5
    """Of the heading, radians: wide, since hips turn to either side in every stride."""
    slow_seconds: float = 0.25
    """Standard deviation of the Gaussian that takes the stride's own rise and fall away."""
    name: str = "travel"
    unit: str = "m/s"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats."""
        missed = self._missed(trial)
        energy = (missed.unsqueeze(-2) * self._units.to(missed.dtype)).sum(-1).square().sum(-1)
        if self.facing is not None:
            apart = trial.heading - self.facing.to(trial.heading.dtype)
            apart = apart - 2 * math.pi * torch.round(apart.detach() / (2 * math.pi))
            energy = energy + (apart / self.sigma_facing).square()
        return 0.5 * energy

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Slow velocity less the wanted one, m/s."""
        return self._missed(trial).norm(dim=-1)

    @cached_property
    def _units(self) -> Float[Tensor, "frames 2 2"]:
        """What velocities are divided by: rows along the wanted velocity and across it, over their sigmas."""
        speed = self.velocities.norm(dim=-1, keepdim=True)
        resting = torch.tensor([0.0, 1.0], dtype=speed.dtype)
        along = torch.where(speed > 1e-6, self.velocities / speed.clamp_min(1e-6), resting)
        across = torch.stack([along[:, 1], -along[:, 0]], dim=-1)
        slip = (self.sigma_direction * speed).clamp_min(self.sigma_speed)  # at rest there is no along and across
        return torch.stack([along / self.sigma_speed, across / slip], dim=-2)

    def _missed(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        known, weights = _build_velocity_smoother(self, trial.before, trial.fps, trial.features.dtype)
        places = trial.root_xz_world
        first = trial.start.position_xz.to(places.dtype).expand(len(places), 1, 2)
        velocities = torch.diff(places, dim=1, prepend=first) * trial.fps - self.velocities.to(places.dtype)
        return known + weights @ velocities


@lru_cache(maxsize=8)
def _build_velocity_smoother(
    term: RootVelocity, before: Float[Tensor, "past joints 3"], fps: float, dtype: torch.dtype
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, "frames frames"]]:
    """What the frames before a window add to its slow velocity error, and the matrix that smooths its own."""
    steps = torch.diff(before[:, 0, ::2].to(dtype), dim=0) * fps
    sigma_frames = term.slow_seconds * fps
    past = min(len(steps), len(term.velocities_before), round(3 * sigma_frames))
    owed = (steps[len(steps) - past :] - term.velocities_before[len(term.velocities_before) - past :]).to(dtype)
    weights = gaussian.averaging_matrix(past + len(term.velocities), sigma_frames, dtype)[past:]
    return weights[:, :past] @ owed, weights[:, past:].contiguous()
