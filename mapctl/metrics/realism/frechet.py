"""Frechet distance between two sets of windows: of the Gaussians that fit their principal components.

As the Frechet inception distance (Heusel et al. 2017, section 2), on standardised joint positions and velocities
instead of a network's features.
"""

from dataclasses import dataclass

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

_LEAST_STD = 1e-3
"""Floor of a feature's standard deviation, m or m/s, so that joints that hardly move do not decide."""


@dataclass(frozen=True, eq=False)
class Basis:
    """Principal components of a reference set of windows; both sets of a distance are projected on one basis."""

    mean: Float[Tensor, "features"]
    """Mean of each feature, m or m/s."""
    std: Float[Tensor, "features"]
    """Standard deviation of each feature, m or m/s."""
    axes: Float[Tensor, "features dims"]
    """Orthonormal axes, in units of the standard deviations."""

    @staticmethod
    def of(windows: Float[Tensor, "windows frames channels"], dims: int) -> "Basis":
        """Fit the first `dims` components; fewer where there are fewer windows."""
        flat = windows.flatten(1)
        mean, std = flat.mean(0), flat.std(0, correction=0).clamp_min(_LEAST_STD)
        return Basis(mean, std, _principal_axes((flat - mean) / std, min(dims, *flat.shape)))

    def project(self, windows: Float[Tensor, "windows frames channels"]) -> Float[Tensor, "windows dims"]:
        """Project windows to coordinates, float64."""
        return (((windows.flatten(1) - self.mean) / self.std) @ self.axes).double()


def _principal_axes(centred: Float[Tensor, "windows features"], dims: int) -> Float[Tensor, "features dims"]:
    """Return principal axes by the smaller of the two Gram matrices: seconds for a clip's worth or a thousand."""
    few = len(centred) < centred.shape[1]
    gram = (centred @ centred.T if few else centred.T @ centred).double().numpy()
    largest = [len(gram) - dims, len(gram) - 1]
    vectors = torch.from_numpy(scipy.linalg.eigh(gram, subset_by_index=largest)[1]).to(centred.dtype)
    return torch.nn.functional.normalize(centred.T @ vectors if few else vectors, dim=0)


def frechet_distance(points: Float[Tensor, "points dims"], reference: Float[Tensor, "others dims"]) -> float:
    """Return |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)) of the points' means and covariances; each set needs two
    points.

    With triangles C = R^T R the root's trace is the sum of the singular values of R1 R2^T, so no matrix root is taken
    and singular covariances (fewer points than dimensions) do no harm.
    """
    first, second = _covariance_triangle(points), _covariance_triangle(reference)
    apart = (points.mean(0) - reference.mean(0)).square().sum()
    return float(
        apart + first.square().sum() + second.square().sum() - 2 * torch.linalg.svdvals(first @ second.T).sum()
    )


def _covariance_triangle(points: Float[Tensor, "points dims"]) -> Float[Tensor, "rows dims"]:
    """Return R with R^T R the covariance."""
    return torch.linalg.qr(points - points.mean(0), mode="r").R / (len(points) - 1) ** 0.5
