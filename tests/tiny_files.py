"""Cards of the small models, and their files."""

from pathlib import Path
from typing import Any

from priors import checkpoints


def make_card(kind: str, config: checkpoints.NetworkConfig, **data: Any) -> checkpoints.Card:
    """Card of invented weights, with these entries on its data."""
    return checkpoints.Card(kind, config.as_card(), licence="none, it is made up", data=data)


def save_model(model: checkpoints.NetworkModel[Any], path: Path) -> Path:
    """Write the weights and the card of a model; returns the path, for options that take a model."""
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoints.save(model.network.state_dict(), model.card, path)
    return path
