"""Paces of a corpus: how fast the hips go in each frame, and whether that is standing, walking or running."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.metrics.pace_changes import PACES, PaceChanges, count_pace_changes, follow_pace, measure_speed
from priors.training.corpus import Corpus


def measure_speeds(corpus: Corpus) -> list[Float[Tensor, " frames"]]:
    """Measure the speeds of the hips over the ground by clip, without the sway within a stride, m/s."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    return [torch.from_numpy(measure_speed(part.numpy(), PRIOR_FPS)).float() for part in parts]


def follow_paces(corpus: Corpus) -> Int[Tensor, " frames"]:
    """Follow the pace of all clips, joined: the index in PACES of each frame."""
    return torch.cat([torch.from_numpy(follow_pace(speed.numpy())) for speed in measure_speeds(corpus)])


def measure_pace_changes(corpus: Corpus) -> dict[str, Any]:
    """Measure minutes by pace (stand, walk, run) and how often the clips change from one pace to another, for a card
    (see `priors.lstm_gmm.labels`)."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    speeds = [measure_speed(part.double().numpy(), PRIOR_FPS) for part in parts]
    pace = np.bincount(np.concatenate([follow_pace(speed) for speed in speeds]), minlength=len(PACES))
    changes = sum((count_pace_changes(speed) for speed in speeds), PaceChanges())
    minutes = {name: round(int(count) / PRIOR_FPS / 60, 2) for name, count in zip(PACES, pace, strict=True)}
    return {"minutes by pace": minutes, **{name: float(count) for name, count in changes.by_name().items()}}
