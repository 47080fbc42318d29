"""Path predictors for tests: one of a few kilobytes with drawn weights, and one that is given the answer."""

from dataclasses import dataclass
from pathlib import Path

import torch
from tiny_files import make_card, save_model

from mapctl import contacts
from mapctl.features import LAYOUT, encode
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.motion import Motion
from mapctl.protocols import PathPredictor
from priors.path import ConvPathPredictor, PathConfig, PathNetwork

CONFIG = PathConfig(width=4)


def network(config: PathConfig = CONFIG, *, seed: int = 0) -> PathNetwork:
    """With weights of this seed."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return PathNetwork(config).eval().requires_grad_(False)


def tiny_path(held_out: dict[str, list[str]] | None = None, *, seed: int = 0) -> ConvPathPredictor:
    """As the controllers take it."""
    return ConvPathPredictor("tiny", network(seed=seed), make_card("path", CONFIG, held_out=held_out or {}))


def save_tiny_path(path: Path, held_out: dict[str, list[str]] | None = None) -> Path:
    """Write the weights and the card; returns the path for --path."""
    return save_model(tiny_path(held_out), path)


@dataclass(frozen=True, eq=False)
class ToldPath(PathPredictor):
    """Answers with the steps of a canonical motion at the prior's rate, as it is or longer."""

    truth: Motion
    """Motion whose trajectory it predicts."""
    stretch: float = 1.0
    """Ratio of its steps to the true ones."""

    def predict(self, motion: LocalMotion) -> RootTrajectory:
        """Ignore the body."""
        features = encode(self.truth)[0].float()[None]
        # A query may have one frame more than the motion at the prior's rate.
        features = features[:, torch.arange(motion.turns.shape[1]).clamp(max=features.shape[1] - 1)]
        return RootTrajectory(
            self.stretch * LAYOUT.pick(features, "root_displacement_heading"),
            LAYOUT.pick(features, "root_height")[..., 0],
            contacts.to_logits(LAYOUT.pick(features, "contacts") > 0.5),
        )
