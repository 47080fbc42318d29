"""Path following: sideways offset from a curve and progress along its arc (Wang et al. 2019, Eq. 17, whose nearest
point has no speed).

Hips sway about the path that a walker follows; a term that pulled every frame onto the curve would put them on rails.
So the slow part of the sideways offset is held tightly, and the raw offset is free up to the usual sway.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.numerics import gaussian
from mapctl.terms.base import TrialGradient, length
from mapctl.terms.local_frames import LocalFrame, find_local_frames
from mapctl.terms.trial import Trial

_SLOW_SECONDS = 0.35  # standard deviation of the Gaussian that separates the slow offset from the sway
_REACH = 0.6  # metres around the wanted arc in which the nearest point is sought: a crossing's other branch is farther


@dataclass(frozen=True, eq=False)
class Path:
    """The hips are on the curve, and at the wanted arc in each frame."""

    curve: Curve
    """Curve on the ground, or in space."""
    arcs: Float[Tensor, " frames"]
    """Wanted arc of each frame of the window, metres."""
    sigma_slow: float = 0.01
    """Standard deviation of the sideways offset after a Gaussian of 0.35 s, metres."""
    free_sway: float = 0.03
    """Sideways offset that costs nothing by itself, metres: mocap sways by 1.9 cm rms."""
    sigma_raw: float = 0.01
    """Standard deviation of the sideways offset beyond `free_sway`, metres."""
    sigma_progress: float = 0.032
    """Standard deviation of the error of the arc, metres."""
    sigma_height: float = 0.03
    """Standard deviation of the height over a curve in space, metres."""
    name: str = "path"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies of the sideways offset, its slow part, progress, and height in space, nats."""
        positions = self._positions(trial)
        near = self._nearest_frame(positions)
        # The curve is held in the gradient. Forward offsets are from the wanted point, the others from the nearest:
        # the straightened curve is at right angles to the other axes.
        offsets = ((positions - near.tangent_extension).unsqueeze(-2) * near.axes).sum(-1)
        beyond = torch.nn.functional.softshrink(offsets[..., :1], self.free_sway)
        errors = torch.cat([beyond, offsets[..., 1:]], dim=-1)
        known, weights = self._build_smoother(trial, offsets.dtype)
        slow = torch.addmm(known, offsets[..., 0], weights)
        return 0.5 * ((errors / errors.new_tensor(self._sigmas)).square().sum(-1) + (slow / self.sigma_slow).square())

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        positions = self._positions(trial)
        near, smoother = self._nearest_frame(positions), self._build_smoother(trial, positions.dtype)
        away, axes, known, weights = (
            each.double().numpy() for each in (positions - near.tangent_extension, near.axes, *smoother)
        )
        offsets, sigmas = np.einsum("bfk,bfak->bfa", away, axes), self._sigmas
        beyond = offsets.copy()
        beyond[..., 0] -= np.clip(offsets[..., 0], -self.free_sway, self.free_sway)
        slow = known + offsets[..., 0] @ weights
        pull = beyond / sigmas**2
        pull[..., 0] += slow @ weights.T / self.sigma_slow**2
        target = gradient.root_xz_world if self.curve.dims == 2 else gradient.joints_world[:, :, 0]
        target[...] += np.einsum("bfa,bfak->bfk", pull, axes)
        return 0.5 * (np.square(beyond / sigmas).sum(-1) + np.square(slow / self.sigma_slow))

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the distance to the curve, metres."""
        positions = self._positions(trial)
        return length(positions - self._nearest_frame(positions).position)

    def _positions(self, trial: Trial) -> Float[Tensor, "batch frames dims"]:
        # On the ground there is no need of the whole body's kinematics.
        return trial.root_xz_world if self.curve.dims == 2 else trial.joints_world[..., 0, :]

    @property
    def _sigmas(self) -> Float[np.ndarray, " dims"]:
        """Standard deviations of the sideways offset, the arc and, in space, the height, metres."""
        return np.array([self.sigma_raw, self.sigma_progress, self.sigma_height][: self.curve.dims])

    def _nearest_frame(self, positions: Float[Tensor, "batch frames dims"]) -> LocalFrame:
        return find_local_frames(self.curve, positions, self.arcs, reach=_REACH)

    def _build_smoother(self, trial: Trial, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        return _build_offset_smoother(self, trial.before, _SLOW_SECONDS * trial.fps, dtype)

    def past_sideways_offsets(self, past: Float[Tensor, "past 3"]) -> Float[Tensor, " past"]:
        """Return the sideways offsets of the frames before the window, metres; their arcs are extrapolated."""
        step = self.arcs[1] - self.arcs[0] if len(self.arcs) > 1 else 0.0
        around = self.arcs[0] - step * torch.arange(len(past), 0, -1)
        positions = past[..., ::2] if self.curve.dims == 2 else past
        near = find_local_frames(self.curve, positions[None], around, reach=_REACH)
        return ((positions - near.position[0]) * near.axes[0, :, 0]).sum(-1)


@lru_cache(maxsize=8)
def _build_offset_smoother(
    path: Path, before: Float[Tensor, "past joints 3"], sigma_frames: float, dtype: torch.dtype
) -> tuple[Float[Tensor, " frames"], Float[Tensor, "frames frames"]]:
    """Contribution of the frames before a window to its smoothed offsets, and the matrix that smooths its own; the same
    at every evaluation of a window. Keys are compared by identity."""
    past = before[-round(3 * sigma_frames) :, 0].detach().to(dtype)
    weights = gaussian.averaging_matrix(len(past) + len(path.arcs), sigma_frames, dtype)[len(past) :].T.contiguous()
    known = path.past_sideways_offsets(past) @ weights[: len(past)] if len(past) else weights.new_zeros(len(path.arcs))
    return known, weights[len(past) :]
