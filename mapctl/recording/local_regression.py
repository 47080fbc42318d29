"""Likelihood of each frame of a track given the frames around it, by local polynomials that leave the frame out.

A polynomial over the neighbours predicts a frame that it has not seen; how well it fits the neighbours themselves
scales the error: externally studentised residuals (Cook and Weisberg 1982, section 2.2.1). The scale of one window has
few degrees of freedom, so it is shrunk to that of the whole track, as far as windows differ no more than chance has
them differ (Smyth 2004, section 4). White noise is thus judged by Gaussian tails, motion that is now quick and now
slow by heavy ones. At the ends of a track and beside frames that are left out the prediction is less certain (its
leverage), and the likelihood with it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Neighbours on either side and degree. Narrow windows follow quick motion, wide ones average noise; of these the one
# that predicts a track best by its likelihood is used (Geisser 1975).
_MODELS = ((2, 1), (3, 3), (4, 3), (6, 3), (6, 2))
_AXES = 3  # degrees of freedom of a rotation and of a position
_LEAST_SPREAD = 1e-3  # variance of the logarithm of windows' scales, below which all have one: 2,000 degrees of freedom


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictions of every frame from its neighbours."""

    mean: Float[Tensor, "frames tracks width"]
    """Predicted values."""
    error: Float[Tensor, "frames tracks"]
    """Distance of the value from the prediction."""
    spread: Float[Tensor, "frames tracks"]
    """Standard deviation of each coordinate about a polynomial, from the neighbours."""
    scale: Float[Tensor, "frames tracks"]
    """Standard error of each coordinate of the prediction: spread and leverage together."""
    freedom: Float[Tensor, "frames tracks"]
    """Degrees of freedom of the scale; 0 where too few neighbours are seen."""

    def log_density(self) -> Float[Tensor, "frames tracks"]:
        """Return the logarithm of the density of each error, Student's t of three coordinates; 0 where unknown."""
        freedom = self.freedom.clamp_min(1e-3)
        square = self.scale.square()
        density = torch.lgamma((freedom + _AXES) / 2) - torch.lgamma(freedom / 2)
        density = density - _AXES / 2 * (math.pi * freedom * square).log()
        density = density - (freedom + _AXES) / 2 * torch.log1p(self.error.square() / (freedom * square))
        return torch.where(self.freedom > 0, density, 0.0)


def predict_frames(
    values: Float[Tensor, "frames tracks width"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
    models: Sequence[tuple[int, int]] = _MODELS,
) -> Prediction:
    """Predict each frame of each track from those of its neighbours that are seen; `least` is the smallest scale that
    a track can have, its resolution."""
    found = [_predict(values, seen, least, side, degree) for side, degree in models]
    scores = torch.stack([_score(prediction, seen) for prediction in found])
    ranks = scores.argsort(dim=0)  # the best comes last, and overrides the others where it has enough neighbours
    best = found[0]
    for rank in ranks:
        for model, prediction in enumerate(found):
            chosen = (rank == model) & (prediction.freedom > 0)
            if chosen.any():
                best = Prediction(
                    torch.where(chosen[..., None], prediction.mean, best.mean),
                    torch.where(chosen, prediction.error, best.error),
                    torch.where(chosen, prediction.spread, best.spread),
                    torch.where(chosen, prediction.scale, best.scale),
                    torch.where(chosen, prediction.freedom, best.freedom),
                )
    return best


def _score(prediction: Prediction, seen: Bool[Tensor, "frames tracks"]) -> Float[Tensor, " tracks"]:
    """Return the mean logarithm of the density of the frames that are seen."""
    counted = seen & (prediction.freedom > 0)
    total = torch.where(counted, prediction.log_density(), 0.0).sum(dim=0)
    return torch.where(counted.any(dim=0), total / counted.sum(dim=0).clamp_min(1), -math.inf)


def _predict(
    values: Float[Tensor, "frames tracks width"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
    side: int,
    degree: int,
) -> Prediction:
    """Predict by polynomials of one degree over so many neighbours on either side."""
    lags = torch.arange(-side, side + 1, dtype=values.dtype) / side
    powers = lags ** torch.arange(2 * degree + 1)[:, None]
    powers[:, side] = 0  # the frame itself is left out
    centre, known = values.mean(dim=0), seen.to(values)
    values = values - centre
    moments = _sum_over_lags(known, powers)
    shown = values * known[..., None]
    sums = torch.stack([_sum_over_lags(shown[..., axis], powers[: degree + 1]) for axis in range(shown.shape[-1])], -1)
    squares = _sum_over_lags(shown.square().sum(dim=-1), powers[:1])[..., 0]
    inverse = _invert(moments, degree)
    mean = torch.einsum("ftp,ftpw->ftw", inverse[..., 0, :], sums)
    residual = (squares - torch.einsum("ftpw,ftpq,ftqw->ft", sums, inverse, sums)).clamp_min(0)
    freedom = _AXES * (moments[..., 0].round() - (degree + 1)).clamp_min(0)
    shrunk, shared = _shrink_scale(residual, freedom, seen, least.square())
    total = torch.where(freedom > 0, freedom + shared, 0.0)
    # A moment of rest is no reason to expect none of the motion that the track has otherwise.
    usual = torch.where(seen & (total > 0), shrunk, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    scale = (torch.maximum(shrunk, usual) * (1 + inverse[..., 0, 0].clamp_min(0))).sqrt()
    return Prediction(mean + centre, (values - mean).norm(dim=-1), shrunk.sqrt(), scale, total)


def _sum_over_lags(
    values: Float[Tensor, "frames tracks"], weights: Float[Tensor, "sums lags"]
) -> Float[Tensor, "frames tracks sums"]:
    """Sum neighbours with weights by lag; beyond the ends there is nothing."""
    side = weights.shape[1] // 2
    return torch.nn.functional.conv1d(values.T[:, None], weights[:, None], padding=side).permute(2, 0, 1)


def _invert(moments: Float[Tensor, "frames tracks sums"], degree: int) -> Float[Tensor, "frames tracks terms terms"]:
    """Invert the normal equations of polynomials; windows of which all frames are seen have one inverse."""
    order = torch.arange(degree + 1)
    normal = moments[..., order[:, None] + order]
    ridge = 1e-9 * torch.eye(degree + 1, dtype=moments.dtype)
    full = moments[..., 0] > moments[..., 0].amax() - 0.5
    inverse = torch.linalg.inv(normal[full][0] + ridge).expand_as(normal).clone()
    inverse[~full] = torch.linalg.inv(normal[~full] + ridge)
    return inverse


def _shrink_scale(
    residual: Float[Tensor, "frames tracks"],
    freedom: Float[Tensor, "frames tracks"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
) -> tuple[Float[Tensor, "frames tracks"], Float[Tensor, " tracks"]]:
    """Return the windows' mean squares, shrunk to their track's (Smyth 2004, section 6.2: the moments of their
    logarithms), and the degrees of freedom of that."""
    counted, half = seen & (freedom > 0), freedom.clamp_min(1) / 2
    square = torch.maximum(residual / freedom.clamp_min(1), least)
    logarithm = square.log() - torch.digamma(half) + half.log()
    count = counted.sum(dim=0).clamp_min(1)
    mean = torch.where(counted, logarithm, 0.0).sum(dim=0) / count
    spread = torch.where(counted, (logarithm - mean).square(), 0.0).sum(dim=0) / (count - 1).clamp_min(1)
    spread -= torch.where(counted, torch.special.polygamma(1, half), 0.0).sum(dim=0) / count
    shared = _invert_trigamma(spread.clamp_min(_LEAST_SPREAD))
    usual = (mean + torch.digamma(shared) - shared.log()).exp()
    shrunk = (2 * shared * usual + residual) / (2 * shared + freedom)
    return torch.maximum(shrunk, least), 2 * shared


def _invert_trigamma(value: Tensor) -> Tensor:
    """Return x with trigamma(x) = value, by Newton's method (Smyth 2004, appendix)."""
    x = 0.5 + 1 / value
    for _ in range(10):
        trigamma = torch.special.polygamma(1, x)
        x = x + trigamma * (1 - trigamma / value) / torch.special.polygamma(2, x)
    return x
