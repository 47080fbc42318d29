"""What a refiner and its critic are told of captured motion, so that they see it in numbers of about unit size."""

import torch
from torch import Tensor

from mapctl.features import LAYOUT
from priors.refiner.end_effectors import compute_end_effectors
from priors.refiner.network import RefinerConfig
from priors.training.corpus import Corpus, find_window_starts


def compute_statistics(corpus: Corpus, config: RefinerConfig, window: int) -> dict[str, Tensor]:
    """Mean and spread of features and end effectors over captured clips, with floors that keep held joints in hand."""
    features = corpus.features
    mean, std = features.mean(0), features.std(0).clamp(min=0.002)
    bits = LAYOUT.slices["contacts"]
    mean[bits], std[bits] = 0.5, 0.5
    starts = find_window_starts(corpus.lengths, window)[:: max(1, window)]
    reach = torch.cat(
        [
            compute_end_effectors(features[rows[:, None] + torch.arange(window)], config.joints).flatten(0, 1)
            for rows in starts.split(512)
        ]
    )
    return {"mean": mean, "std": std, "reach_mean": reach.mean(0), "reach_std": reach.std(0).clamp(min=0.01)}
