"""A density of a few kilobytes that glides: small enough for tests that need any prior, not a good one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from mapctl.features import LAYOUT
from mapctl.protocols import DataLimits
from priors import checkpoints
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig

SPEED = 1.2
CONFIG = LstmGmmConfig(width=16, components=2)
ABILITIES = DataLimits(slowest=0.2, fastest=2.0, turn_rate=1.5)


def save_tiny_prior(
    path: Path,
    *,
    seed: int = 0,
    starts: int = 8,
    labels: tuple[str, ...] = (),
    held_out: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """Write the weights and the card, which names the clips that training did not see; returns the path for --prior."""
    torch.manual_seed(seed)
    mean, std = _statistics()
    config = replace(CONFIG, labels=labels)
    model = LstmGmm(config, mean=mean, std=std)
    tensors = {name: value.detach().clone() for name, value in model.state_dict().items()}
    tensors |= {
        "starts.previous": mean + std * torch.randn(starts, 1),
        "starts.hidden": torch.zeros(2, starts, CONFIG.width),
        "starts.cell": torch.zeros(2, starts, CONFIG.width),
        "starts.speed": torch.linspace(0.8, 1.6, starts),
        "starts.weight": torch.full((starts,), 1 / starts),
    }
    card = checkpoints.Card(
        kind="lstm-gmm",
        config=config.as_card(),
        licence="none, it is made up",
        data={"starts": [f"start {number}" for number in range(starts)], "held_out": dict(held_out or {})},
        quality={"mocap": {"sway_cm": {"mean": 1.9, "p2": 1.2, "p98": 2.6}}},
        abilities=asdict(ABILITIES),
    )
    checkpoints.save(tensors, card, path)
    return path


def _statistics() -> tuple[torch.Tensor, torch.Tensor]:
    """A T-pose that slides forward at 1.2 m/s, and spreads wide enough for a solver to steer by."""
    mean, std = torch.zeros(LAYOUT.size), torch.full((LAYOUT.size,), 0.02)
    mean[LAYOUT.slices["root_displacement_heading"]] = torch.tensor([0.0, SPEED / 30])
    mean[LAYOUT.slices["root_height"]] = 0.9
    mean[LAYOUT.slices["contacts"]], std[LAYOUT.slices["contacts"]] = 0.5, 0.5
    std[LAYOUT.slices["root_displacement_heading"]] = 0.01
    std[LAYOUT.slices["heading_change"]] = 0.05
    return mean, std
