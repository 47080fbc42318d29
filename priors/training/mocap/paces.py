"""Paces of a corpus: how fast somebody goes in each frame, and whether that is standing, walking or running."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.metrics.pace_changes import follow_pace, measure_speed
from priors.training.corpus import Corpus


def measure_speeds(corpus: Corpus) -> list[Float[Tensor, " frames"]]:
    """Measure the speeds of the hips over the ground by clip, without the sway within a stride, m/s."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    return [torch.from_numpy(measure_speed(part.numpy(), PRIOR_FPS)).float() for part in parts]


def follow_paces(corpus: Corpus) -> Int[Tensor, " frames"]:
    """Follow the pace of all clips, joined: the index in PACES of each frame."""
    return torch.cat([torch.from_numpy(follow_pace(speed.numpy())) for speed in measure_speeds(corpus)])
