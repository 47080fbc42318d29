"""Paces of a corpus: how fast somebody goes in each frame, and whether that is standing, walking or running."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.metrics.pace_changes import compute_ground_velocity, follow_pace
from priors.training.corpus import Corpus


def measure_speeds(corpus: Corpus) -> list[Float[Tensor, " frames"]]:
    """Measure the speeds of the hips over the ground by clip, without the sway within a stride, m/s."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    return [
        torch.from_numpy(np.linalg.norm(compute_ground_velocity(part.numpy(), PRIOR_FPS), axis=1)).float()
        if len(part) > 1
        else torch.zeros(len(part))
        for part in parts
    ]


def follow_paces(corpus: Corpus) -> Int[Tensor, " frames"]:
    """Follow the pace of all clips, joined: the index in PACES of each frame."""
    return torch.cat([torch.from_numpy(follow_pace(speed.numpy())) for speed in measure_speeds(corpus)])
