"""Terms of steering (Wang et al. 2019, section 5.3): velocity over the ground and heading (Eq. 20-23), and step length.

The paper holds the mean speed of a window and the direction of its last frame. Speed rises and falls within a stride
and hips sway, so here the slow part of the velocity is held, frame by frame: both may change within a window.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.numerics import gaussian
from mapctl.terms.base import TrialGradient, length
from mapctl.terms.trial import Trial

_SLOW_SECONDS = 0.25  # standard deviation of the Gaussian that removes a stride's own rise and fall of speed


@dataclass(frozen=True, eq=False)
class RootVelocity:
    """The low-pass velocity of the hips over the ground is the target's, and so is the heading."""

    velocities: Float[Tensor, "frames 2"]
    """Target velocity (world x and z) in each frame of the window, m/s; zero is to stand."""
    velocities_before: Float[Tensor, "past 2"]
    """Target velocity in the frames before the window, m/s, oldest first: their error counts in the low pass."""
    facing: Float[Tensor, " frames"] | None = None
    """Target heading of the hips in each frame, radians about +Y; None leaves it to the prior."""
    sigma_speed: float = 0.1
    """Standard deviation of the low-pass velocity along the target, m/s."""
    sigma_direction: float = 0.1
    """Standard deviation of the low-pass velocity across the target, as an angle, radians."""
    sigma_facing: float = 0.5
    """Standard deviation of the heading, radians: wide, since hips turn to either side in every stride."""
    name: str = "travel"
    unit: str = "m/s"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats."""
        error = self._velocity_error(trial)
        energy = (error.unsqueeze(-2) * self._units.to(error.dtype)).sum(-1).square().sum(-1)
        if self.facing is not None:
            apart = trial.heading - self.facing.to(trial.heading.dtype)
            apart = apart - 2 * math.pi * torch.round(apart.detach() / (2 * math.pi))
            energy = energy + (apart / self.sigma_facing).square()
        return 0.5 * energy

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        velocities, units, facing = self._tables
        known, weights = _build_velocity_smoother(self, trial.before, trial.fps, trial.features.dtype)
        known, weights, ground = known.double().numpy(), weights.double().numpy(), trial.root_xz_world.double().numpy()
        start = trial.start.position_xz.double().expand(len(ground), 2)[:, None].numpy()
        raw = float(trial.fps) * np.diff(ground, axis=1, prepend=start) - velocities
        error = np.einsum("fak,bfk->bfa", units, known + weights @ raw)
        pull = weights.T @ np.einsum("fak,bfa->bfk", units, error)
        gradient.root_xz_world[...] -= float(trial.fps) * np.diff(pull, axis=1, append=0)
        energy = 0.5 * np.square(error).sum(-1)
        if facing is not None:
            apart = trial.heading.double().numpy() - facing
            apart = (apart - 2 * math.pi * np.rint(apart / (2 * math.pi))) / self.sigma_facing
            gradient.heading[...] += apart / self.sigma_facing
            energy += 0.5 * np.square(apart)
        return energy

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the size of the low-pass velocity error, m/s."""
        return length(self._velocity_error(trial))

    @cached_property
    def _units(self) -> Float[Tensor, "frames 2 2"]:
        """Axes along and across the target velocity, each divided by its sigma, m/s."""
        speed = length(self.velocities).unsqueeze(-1)
        resting = torch.tensor([0.0, 1.0], dtype=speed.dtype)
        along = torch.where(speed > 1e-6, self.velocities / speed.clamp_min(1e-6), resting)
        across = torch.stack([along[:, 1], -along[:, 0]], dim=-1)
        sigma_across = (self.sigma_direction * speed).clamp_min(self.sigma_speed)  # at rest there is no direction
        return torch.stack([along / self.sigma_speed, across / sigma_across], dim=-2)

    @cached_property
    def _tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Target velocities, axes and headings in double precision."""
        facing = None if self.facing is None else self.facing.double().numpy()
        return self.velocities.double().numpy(), self._units.double().numpy(), facing

    def _velocity_error(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        known, weights = _build_velocity_smoother(self, trial.before, trial.fps, trial.features.dtype)
        ground = trial.root_xz_world
        first = trial.start.position_xz.to(ground.dtype).expand(len(ground), 2)[:, None]
        error = torch.diff(ground, dim=1, prepend=first) * trial.fps - self.velocities.to(ground.dtype)
        return known + weights @ error


@lru_cache(maxsize=8)
def _build_velocity_smoother(
    term: RootVelocity, before: Float[Tensor, "past joints 3"], fps: float, dtype: torch.dtype
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, "frames frames"]]:
    """Contribution of the frames before a window to its low-pass velocity error, and the matrix that smooths its
    own."""
    steps = torch.diff(before[:, 0, ::2].to(dtype), dim=0) * fps
    sigma_frames = _SLOW_SECONDS * fps
    past = min(len(steps), len(term.velocities_before), round(3 * sigma_frames))
    error = (steps[len(steps) - past :] - term.velocities_before[len(term.velocities_before) - past :]).to(dtype)
    weights = gaussian.averaging_matrix(past + len(term.velocities), sigma_frames, dtype)[past:]
    return weights[:, :past] @ error, weights[:, past:].contiguous()


_NEVER = -2  # below every frame


@dataclass(frozen=True)
class StepLength:
    """A toe that touches down is at a target distance from where the other one was last planted.

    Touch-downs are those of the prior's contact bits, as in foot contact. One after which the other toe was last
    planted before the window counts only if that was in the frame just before it.
    """

    length: float
    """Target distance over the ground, metres."""
    sigma: float = 0.012
    """Standard deviation of a step's length, metres: small, since few frames of a window are touch-downs."""
    name: str = "steps"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies in the frames of touch-downs, nats; 0 in all others."""
        return 0.5 * (self._length_error(trial) / self.sigma).square()

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        (row, frame, foot, last), apart = self._measure_steps(trial)
        lengths, toes = torch.sqrt(apart.square().sum(-1) + 1e-12), torch.tensor(trial.toes)
        error = self._sum_errors(trial, row, frame, lengths)
        pull = (error[row, frame] / lengths / self.sigma**2)[:, None] * apart
        slope, inside = torch.as_tensor(gradient.joints_world)[..., ::2], last >= 0
        slope.index_put_((row, frame, toes[foot]), pull, accumulate=True)
        slope.index_put_((row[inside], last[inside], toes[1 - foot[inside]]), -pull[inside], accumulate=True)
        return 0.5 * np.square(error.double().numpy() / self.sigma)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the error of the step length, metres; 0 between touch-downs."""
        return self._length_error(trial).abs()

    def _length_error(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        (row, frame, *_), apart = self._measure_steps(trial)
        return self._sum_errors(trial, row, frame, torch.sqrt(apart.square().sum(-1) + 1e-12))

    def _sum_errors(self, trial: Trial, row: Tensor, frame: Tensor, lengths: Tensor) -> Float[Tensor, "batch frames"]:
        errors = torch.zeros_like(trial.features[..., 0])
        return errors.index_put((row, frame), lengths - self.length, accumulate=True)

    def _measure_steps(self, trial: Trial) -> tuple[tuple[Tensor, ...], Float[Tensor, "steps 2"]]:
        """Find the touch-downs, and the vectors over the ground to each from where the other toe was last planted."""
        toes = trial.joints_world[..., trial.toes, ::2]
        if len(trial.before):
            feet = trial.before[-1, trial.toes, ::2].to(toes.dtype)
            toes = torch.cat([feet.expand(len(toes), 1, 2, 2), toes], dim=1)
        shift = int(len(trial.before) > 0)
        row, frame, foot, last = found = _find_touch_downs(trial)
        return found, toes[row, frame + shift, foot] - toes[row, last + shift, 1 - foot]


def _find_touch_downs(trial: Trial) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Batch row, frame and foot of each touch-down, and the frame in which the other foot was last planted; -1 is the
    frame before the window."""
    planted = trial.planted
    known = planted.clone()
    known[:, 0] &= len(trial.before) > 0  # else its position is not known
    frames = torch.arange(-1, planted.shape[1] - 1)[:, None]
    last = torch.where(known, frames, _NEVER).cummax(dim=1).values[:, 1:].flip(-1)
    row, frame, foot = (planted[:, 1:] & ~planted[:, :-1] & (last > _NEVER)).nonzero().unbind(-1)
    return row, frame, foot, last[row, frame, foot]
