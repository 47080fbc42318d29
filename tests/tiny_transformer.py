"""A pose transformer of a few kilobytes: untrained it interpolates, with drawn weights something else."""

from pathlib import Path

import torch
from tiny_files import make_card, save_model

from priors.pose_transformer import PoseTransformer, PoseTransformerConfig, PoseTransformerNetwork

CONFIG = PoseTransformerConfig(width=16, layers=1, heads=2, kernel=3, detail=1)


def network(*, drawn: float = 0.0, seed: int = 0, config: PoseTransformerConfig = CONFIG) -> PoseTransformerNetwork:
    """Weights that are nil untrained are drawn with this spread."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = PoseTransformerNetwork(config)
        for parameter in (*result.head.parameters(), *result.detail.head.parameters()):
            if drawn:
                torch.nn.init.normal_(parameter, std=drawn)
    result.std_rotation.fill_(0.3)
    result.mean_position[0, 1] = 0.9
    return result.eval().requires_grad_(False)


def tiny_transformer(*, drawn: float = 0.0, seed: int = 0) -> PoseTransformer:
    """As the controllers take it."""
    return PoseTransformer("tiny", network(drawn=drawn, seed=seed), make_card("pose-transformer", CONFIG))


def save_tiny_transformer(path: Path, *, drawn: float = 0.0) -> Path:
    """Write the weights and the card; returns the path for --inbetweener."""
    return save_model(tiny_transformer(drawn=drawn), path)
