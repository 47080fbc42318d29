"""A small stitcher, for tests."""

from pathlib import Path

import torch
from tiny_files import make_card, save_model

from mapctl.features import LAYOUT
from priors.stitcher import Stitcher, StitcherConfig, StitcherNetwork

CONFIG = StitcherConfig(
    embedding=(10, 8),
    encoder=8,
    head=6,
    shared=2,
    own=2,
    decoder=12,
    experts=2,
    expert=(8,),
    gate=(6,),
    phase=6,
    longest=24,
)


def network(config: StitcherConfig = CONFIG, *, drawn: float = 0.3, seed: int = 0) -> StitcherNetwork:
    """Drawn with the seed; makes so much of its own beside the interpolation."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = StitcherNetwork(config)
    result.experts.shrink_last(10 * drawn)
    result.change[:], result.std[:] = 0.03, 0.3
    result.std[LAYOUT.slices["root_displacement_heading"]] = result.std[LAYOUT.slices["heading_change"]] = 0.02
    return result.eval().requires_grad_(False)


def save_tiny_stitcher(path: Path, *, drawn: float = 0.3) -> Path:
    """Write the weights and the card; returns the path for --stitcher."""
    return save_model(tiny_stitcher(drawn=drawn), path)


def tiny_stitcher(config: StitcherConfig = CONFIG, *, drawn: float = 0.3) -> Stitcher:
    """As controllers take it."""
    return Stitcher("tiny", network(config, drawn=drawn), make_card("stitcher", config))
