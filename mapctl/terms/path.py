"""Follow a curve: sideways distance and progress along the arc (rnn paper, Eq. 17, whose nearest point has no speed).

Hips sway about the path a walker follows; a term that pulled every frame onto the curve would put them on rails. So the
slow part of the sideways offset is held tightly and the raw offset is free up to a sway that people have.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.curves.local_frame import LocalFrame, find_local_frames
from mapctl.numerics import gaussian
from mapctl.terms.trial import Trial

_REACH = 0.6  # metres around the wanted arc where the nearest place is sought: a crossing's other branch is farther


@dataclass(frozen=True, eq=False)
class Path:
    """The chosen joint stays on the curve and is at the wanted arc at the wanted time."""

    curve: Curve
    """On the ground, or in space for a joint's own path."""
    arcs: Float[Tensor, " frames"]
    """Wanted arc of each frame of the window, metres."""
    joint: str = "hips"
    """Which joint follows."""
    sigma_slow: float = 0.025
    """Of the sideways offset after a Gaussian of `slow_seconds`, metres."""
    free_sway: float = 0.03
    """Sideways offset that is nobody's business but the walker's, metres: mocap sways by 1.9 cm rms."""
    sigma_raw: float = 0.025
    """Of the sideways offset beyond that, metres."""
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
        near = self._nearest_frame(places)
        # The curve is held in the gradient. Forward offsets are from the wanted place, the others from the nearest:
        # the straightened curve is at right angles to the other axes.
        offsets = ((places - near.tangent_extension).unsqueeze(-2) * near.axes).sum(-1)
        beyond = torch.nn.functional.softshrink(offsets[..., :1], self.free_sway)
        wrong = torch.cat([beyond, offsets[..., 1:]], dim=-1)
        energy = (wrong / self._axis_sigmas(places.dtype)).square().sum(-1)
        return 0.5 * (energy + (self._low_pass_offset(trial, offsets[..., 0]) / self.sigma_slow).square())

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Distance to the curve, metres."""
        places = self._places(trial)
        return (places - self._nearest_frame(places).place).norm(dim=-1)

    def _places(self, trial: Trial) -> Float[Tensor, "batch frames dims"]:
        if self.joint == "hips" and self.curve.dims == 2:  # no need of the whole body's kinematics
            return trial.root_xz_world
        return self._of_curve(trial.joint_world(self.joint))

    def _of_curve(self, places: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch dims"]:
        return places[..., ::2] if self.curve.dims == 2 else places

    def _nearest_frame(self, places: Tensor) -> LocalFrame:
        return find_local_frames(self.curve, places, self.arcs, reach=_REACH)

    def _axis_sigmas(self, dtype: torch.dtype) -> Float[Tensor, " dims"]:
        """Of the offsets along the axes."""
        return torch.tensor((self.sigma_raw, self.sigma_progress, self.sigma_height)[: self.curve.dims], dtype=dtype)

    def _low_pass_offset(self, trial: Trial, sideways: Tensor) -> Tensor:
        """The offset smoothed over time; the frames before the window count, missing ones do not."""
        sigma = self.slow_seconds * trial.fps
        known, weights = _build_offset_smoother(
            self, trial.before, trial.skeleton.index(self.joint), sigma, sideways.dtype
        )
        return torch.addmm(known, sideways, weights)

    def _past_sideways_offsets(self, past: Float[Tensor, "past 3"]) -> Float[Tensor, " past"]:
        """Sideways offsets of the frames before the window, metres; arcs go on backwards at the first frame's pace."""
        step = self.arcs[1] - self.arcs[0] if len(self.arcs) > 1 else 0.0
        around = self.arcs[0] - step * torch.arange(len(past), 0, -1)
        places = self._of_curve(past)
        near = find_local_frames(self.curve, places[None], around, reach=_REACH)
        return ((places - near.place[0]) * near.axes[0, :, 0]).sum(-1)


@lru_cache(maxsize=8)
def _build_offset_smoother(
    path: Path, before: Float[Tensor, "past joints 3"], joint: int, sigma_frames: float, dtype: torch.dtype
) -> tuple[Float[Tensor, " frames"], Float[Tensor, "frames frames"]]:
    """What the frames before a window add to its smoothed offsets, and the matrix that smooths its own.

    The same at every evaluation of a window; tensors are compared by identity.
    """
    past = before[-round(3 * sigma_frames) :, joint].detach().to(dtype)
    weights = gaussian.averaging_matrix(len(past) + len(path.arcs), sigma_frames, dtype)[len(past) :].T.contiguous()
    known = path._past_sideways_offsets(past) @ weights[: len(past)] if len(past) else weights.new_zeros(len(path.arcs))
    return known, weights[len(past) :]
