"""Mean and spread of features, by which a density's are normalised."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, mirror_features


def compute_feature_statistics(features: Float[Tensor, "frames size"]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of features and their mirror image; floors keep held joints from exploding.

    Rotations are held to at least 0.01 rad (0.6 degrees), displacements to 1 mm; contact bits map to -1 and 1.
    """
    both = torch.cat([features, mirror_features(features)])
    mean, std = both.mean(0), both.std(0)
    floor = torch.full_like(std, 0.01)
    floor[LAYOUT.slices["root_displacement_heading"]] = 0.001
    floor[LAYOUT.slices["heading_change"]] = 0.002
    for values in (mean, floor, std):
        values[LAYOUT.slices["contacts"]] = 0.5
    return mean, torch.maximum(std, floor)
