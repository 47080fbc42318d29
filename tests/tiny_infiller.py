"""An infiller of a few kilobytes: untrained it draws straight lines, with drawn weights something else."""

from pathlib import Path

import torch

from priors import checkpoints
from priors.infiller.network import ConvInfiller, InfillerConfig, InfillerNetwork

CONFIG = InfillerConfig(widths=(8, 8, 8, 8, 8))
_SPREAD = 0.1  # metres: what one unit of a place is


def network(*, drawn: float = 0.0, seed: int = 0, config: InfillerConfig = CONFIG) -> InfillerNetwork:
    """Layers that are nil untrained are drawn with this spread."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        made = InfillerNetwork(config)
        for parameter in made.parameters():
            if drawn and not parameter.any():
                torch.nn.init.normal_(parameter, std=drawn)
    made.std.fill_(_SPREAD)
    return made.eval().requires_grad_(False)


def card() -> checkpoints.Card:
    """Of the tiny infiller."""
    return checkpoints.Card(
        "infiller", CONFIG.as_card(), licence="none, it is made up", **checkpoints.Card.layout_fields()
    )


def tiny_infiller(*, drawn: float = 0.0, seed: int = 0) -> ConvInfiller:
    """As the controllers take it."""
    return ConvInfiller("tiny", network(drawn=drawn, seed=seed), card())


def save_tiny_infiller(path: Path, *, drawn: float = 0.0) -> Path:
    """Write the weights and the card; returns the path for --infiller."""
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoints.save(network(drawn=drawn).state_dict(), card(), path)
    return path
