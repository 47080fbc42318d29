"""A generator of long in-betweens of a few kilobytes, with drawn weights."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import tiny_path
import torch
from tiny_files import make_card
from torch import Tensor

from mapctl.protocols import PathPredictor
from priors import checkpoints
from priors.checkpoints import compute_hash
from priors.tweener import GeneratorConfig, GeneratorNetwork, Tweener, encode_classes

CONFIG = GeneratorConfig((8, 8, 8, 12, 12, 12), (12, 12, 8, 8, 8, 8), style=5)


def network(*, seed: int = 0, drawn: float = 0.05) -> GeneratorNetwork:
    """With weights of this seed; those of the last layer are drawn with this spread."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = GeneratorNetwork(CONFIG)
        torch.nn.init.normal_(result.last.weight, std=drawn)
    return result.eval().requires_grad_(False)


def card(
    path: str = "", classes: Sequence[str] = (), held_out: Mapping[str, Sequence[str]] | None = None
) -> checkpoints.Card:
    """Card of the tiny tweener, trained with the path predictor of this hash, with invented classes."""
    members = {name: [_draw_poses(name)] for name in classes}
    encoded = encode_classes(network().style, members) if classes else {}
    return make_card("tweener", CONFIG, path=path, held_out=held_out or {}, **encoded)


def tiny_tweener(*, seed: int = 0, path: PathPredictor | None = None) -> Tweener:
    """As the controllers take it."""
    return Tweener("tiny", network(seed=seed), card(), path or tiny_path.tiny_path())


def save_tiny_tweener(
    path: Path, predictor: str, classes: Sequence[str] = (), held_out: Mapping[str, Sequence[str]] | None = None
) -> Path:
    """Write the weights and the card, for this file of a path predictor; returns the path for --inbetweener."""
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoints.save(network().state_dict(), card(compute_hash(predictor), classes, held_out), path)
    return path


def _draw_poses(name: str) -> Tensor:
    """Poses that are different for every name, metres."""
    return torch.randn(3, 21, 3, generator=torch.Generator().manual_seed(len(name)))
