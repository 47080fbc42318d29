"""Evidence of windows against their nearest ones of the other set, by joint, band, frame and kind of input.

Between a made window m and a mocap window c the logit f changes by f(m) - f(c), the integral of its gradient along the
straight way from c to m. As windows are sums of parts, so is that integral: each part's share is its own difference
times the mean gradient (integrated gradients, Sundararajan et al. 2017, Eq. 1), and shares add up to the change. A
matched window of mocap stands where that paper has a black picture.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mapctl.features import PRIOR_FPS
from mapctl.metrics.realism.evidence.parts import join_parts, pull_back
from mapctl.metrics.realism.evidence.rows import Rows, join_rows

INPUTS = ("positions", "velocities")
"""Kinds of input."""

_BATCH = 128


@dataclass(frozen=True, eq=False)
class PathEvidence(Rows):
    """Evidence that a window is made, against mocap, in units of the logit: sums over parts are equal."""

    cells: Float[Tensor, "windows bands joints"]
    """Evidence by band and joint."""
    frames: Float[Tensor, "windows frames joints"]
    """Evidence by frame and joint."""
    inputs: Float[Tensor, "windows 2"]
    """Evidence by kind of input, INPUTS."""


def find_nearest(
    own: Float[Tensor, "windows dims"], others: Float[Tensor, "others dims"], count: int
) -> Int[Tensor, "windows count"]:
    """Find the nearest windows of the other set, by coordinates such as `Basis.project` gives."""
    return torch.cdist(own, others).topk(min(count, len(others)), dim=1, largest=False).indices


def gather_evidence(
    network: nn.Module,
    made: Float[Tensor, "windows bands frames_and_one joints 3"],
    mocap: Float[Tensor, "windows bands frames_and_one joints 3"],
    *,
    steps: int,
) -> PathEvidence:
    """Gather the evidence of each made window against the mocap window of the same row, from `steps` points of the
    way."""
    pairs = zip(made.split(_BATCH), mocap.split(_BATCH), strict=True)
    return join_rows([_gather_batch(network, *pair, steps) for pair in pairs])


def _gather_batch(network: nn.Module, made: Tensor, mocap: Tensor, steps: int) -> PathEvidence:
    apart = made - mocap
    end, change = join_parts(mocap.sum(dim=1)), join_parts(apart.sum(dim=1))
    gradient = _average_gradient(network, end, change, steps)
    by_place, by_velocity = (each.unsqueeze(1) for each in pull_back(gradient))
    velocity = apart.diff(dim=2) * PRIOR_FPS
    evidence = (by_place * apart[:, :, 1:] + by_velocity * velocity).sum(dim=-1)
    inputs = (gradient * change).unflatten(-1, (len(INPUTS), -1)).sum(dim=(1, 3))
    return PathEvidence(evidence.sum(dim=2), evidence.sum(dim=1), inputs)


def _average_gradient(network: nn.Module, start: Tensor, change: Tensor, steps: int) -> Tensor:
    """Average the logit's gradient over the middles of equal pieces of the way."""
    total = torch.zeros_like(start)
    for step in range(steps):
        at = (start + (step + 0.5) / steps * change).requires_grad_()
        (gradient,) = torch.autograd.grad(network(at).sum(), at)
        total += gradient
    return total / steps


@torch.no_grad()
def exchange_groups(
    network: nn.Module,
    own: Float[Tensor, "windows bands frames_and_one joints 3"],
    others: Float[Tensor, "windows bands frames_and_one joints 3"],
) -> Float[Tensor, "windows groups"]:
    """Return the logits of windows that take one group after the other from the other set's window of the same row:
    each band, each joint, then each kind of input."""
    logits = []
    for mine, theirs in zip(own.split(_BATCH), others.split(_BATCH), strict=True):
        apart, channels = theirs - mine, join_parts(mine.sum(dim=1))
        bones = apart.sum(dim=1)
        joints = bones * torch.eye(bones.shape[2])[:, None, None, :, None]
        changes = [join_parts(change) for change in (*apart.transpose(0, 1), *joints)]
        whole = join_parts(bones).unflatten(-1, (len(INPUTS), -1))
        for kind in range(len(INPUTS)):
            only = torch.zeros_like(whole)
            only[:, :, kind] = whole[:, :, kind]
            changes.append(only.flatten(-2))
        logits.append(torch.stack([network(channels + change) for change in changes], dim=-1))
    return torch.cat(logits)
