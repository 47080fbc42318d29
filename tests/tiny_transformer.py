"""A pose transformer of a few kilobytes: untrained it interpolates, with drawn weights something else."""

from pathlib import Path

import torch

from priors import checkpoints
from priors.pose_transformer import PoseTransformer, PoseTransformerConfig, PoseTransformerNetwork

CONFIG = PoseTransformerConfig(width=16, layers=1, heads=2, kernel=3)


def network(*, drawn: float = 0.0, seed: int = 0, config: PoseTransformerConfig = CONFIG) -> PoseTransformerNetwork:
    """Weights that are nil untrained are drawn with this spread."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = PoseTransformerNetwork(config)
        for parameter in result.head.parameters():
            if drawn:
                torch.nn.init.normal_(parameter, std=drawn)
    result.std_rotation.fill_(0.3)
    result.mean_position[0, 1] = 0.9
    return result.eval().requires_grad_(False)


def card(config: PoseTransformerConfig = CONFIG) -> checkpoints.Card:
    """Card of the tiny transformer."""
    return checkpoints.Card(
        "pose-transformer", config.as_card(), licence="none, it is made up", **checkpoints.Card.layout_fields()
    )


def tiny_transformer(*, drawn: float = 0.0, seed: int = 0) -> PoseTransformer:
    """As the controllers take it."""
    return PoseTransformer("tiny", network(drawn=drawn, seed=seed), card())


def save_tiny_transformer(path: Path, *, drawn: float = 0.0) -> Path:
    """Write the weights and the card; returns the path for --inbetweener."""
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoints.save(network(drawn=drawn).state_dict(), card(), path)
    return path
