"""Measures of transitions as the LaFAN1 benchmark defines them (Harvey et al. 2020, section 5): L2P, L2Q, NPSS; and the
errors of Ren et al. 2024, section 4: ADE, that at the last frame, and the APD of several answers.

All take batches of windows of one length, at the frames that were made, in the world on canonical joints.
"""

import torch
from jaxtyping import Float
from torch import Tensor

_NO_POWER = 1e-9  # of the truth's spectrum, under which a coordinate does not move


def compute_l2p(
    made: Float[Tensor, "windows frames joints 3"],
    truth: Float[Tensor, "windows frames joints 3"],
    std: Float[Tensor, "joints 3"],
) -> float:
    """Return the mean over windows and frames of the length of the error in all coordinates, each divided by its
    standard deviation in the training data.
    """
    return float(((made - truth) / std).flatten(-2).norm(dim=-1).mean())


def compute_l2q(
    made: Float[Tensor, "windows frames joints 4"], truth: Float[Tensor, "windows frames joints 4"]
) -> float:
    """Return the mean over windows and frames of the length of the error in all world quaternions, whose signs are
    chosen nearest to the truth joint by joint and frame by frame.
    """
    return float((align_signs(made, truth) - truth).flatten(-2).norm(dim=-1).mean())


def compute_npss(
    made: Float[Tensor, "windows frames joints 4"], truth: Float[Tensor, "windows frames joints 4"]
) -> float:
    """Return the normalised power spectrum similarity (Gopalakrishnan et al. 2019) of world quaternions, 0 at best.

    The spectrum is the squared real part of the transform over frames, as in LaFAN1's code; its cumulated shares are
    compared coordinate by coordinate, weighted by the truth's power over all windows. Signs are continuous in time in
    the truth, and nearest to it in what was made. A coordinate without power counts nothing.
    """
    truth = make_signs_continuous(truth)
    spectra = [torch.fft.fft(x.flatten(-2).double(), dim=1).real.square() for x in (truth, align_signs(made, truth))]
    power = spectra[0].sum(dim=1)
    shares = [each / each.sum(dim=1, keepdim=True).clamp_min(1e-30) for each in spectra]
    distance = (shares[0].cumsum(dim=1) - shares[1].cumsum(dim=1)).abs().sum(dim=1)
    weight = torch.where(power > _NO_POWER, power, 0.0)
    return float((distance * weight).sum() / weight.sum())


def compute_joint_distances(
    made: Float[Tensor, "windows frames joints 3"], truth: Float[Tensor, "windows frames joints 3"]
) -> tuple[float, float]:
    """Return the mean distance of joints from their true places over all frames (ADE), and in the last one; metres."""
    distance = (made - truth).norm(dim=-1)
    return float(distance.mean()), float(distance[:, -1].mean())


def compute_pairwise_distances(draws: Float[Tensor, "draws frames joints 3"]) -> tuple[float, float]:
    """Return the mean distance of joints between two of several answers to one question, and the mean distance between
    two of them as vectors of all frames' coordinates; the unit of the positions. The second is the APD of Ren et al.
    2024, section 4.1, whose figures are compatible with centimetres.
    """
    count = len(draws)
    rows, columns = torch.triu_indices(count, count, offset=1)
    apart = draws[rows] - draws[columns]
    return float(apart.norm(dim=-1).mean()), float(apart.flatten(1).norm(dim=1).mean())


def align_signs(made: Float[Tensor, "*batch 4"], truth: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the same rotations by the quaternions nearest to the truth's."""
    return torch.where((made * truth).sum(dim=-1, keepdim=True) < 0, -made, made)


def make_signs_continuous(quats: Float[Tensor, "windows frames joints 4"]) -> Float[Tensor, "windows frames joints 4"]:
    """Return the same rotations by quaternions that do not jump from frame to frame."""
    flips = torch.where((quats[:, 1:] * quats[:, :-1]).sum(dim=-1, keepdim=True) < 0, -1.0, 1.0).to(quats)
    return torch.cat([quats[:, :1], quats[:, 1:] * flips.cumprod(dim=1)], dim=1)
