"""An infiller of a few kilobytes: untrained it draws straight lines, with drawn weights something else."""

from pathlib import Path

import torch
from tiny_files import make_card, save_model

from mapctl import kinematics
from mapctl.inbetweening import PositionImage
from mapctl.skeleton import CANONICAL
from priors.infiller import ConvInfiller, InfillerConfig, InfillerNetwork

CONFIG = InfillerConfig(widths=(8, 8, 8, 8, 8))
_SPREAD = 0.1  # metres: what one unit of a place is


def network(*, drawn: float = 0.0, seed: int = 0, config: InfillerConfig = CONFIG) -> InfillerNetwork:
    """Layers that are nil untrained are drawn with this spread."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = InfillerNetwork(config)
        for parameter in result.parameters():
            if drawn and not parameter.any():
                torch.nn.init.normal_(parameter, std=drawn)
    result.std.fill_(_SPREAD)
    return result.eval().requires_grad_(False)


def tiny_infiller(*, drawn: float = 0.0, seed: int = 0, config: InfillerConfig = CONFIG) -> ConvInfiller:
    """As the controllers take it."""
    return ConvInfiller("tiny", network(drawn=drawn, seed=seed, config=config), make_card("infiller", config))


def save_tiny_infiller(path: Path, *, drawn: float = 0.0, config: InfillerConfig = CONFIG) -> Path:
    """Write the weights and the card; returns the path for --inbetweener."""
    return save_model(tiny_infiller(drawn=drawn, config=config), path)


def shown(motion, known=None, *, contacts=None):
    """The image of a canonical motion, of which all is known unless said otherwise."""
    positions, frames = motion.joint_positions()[None], motion.num_frames
    whole = torch.ones(1, frames, CANONICAL.num_joints, dtype=torch.bool)
    return PositionImage.of_world(
        positions,
        kinematics.heading(motion.local_quat_xyzw[:, 0])[None],
        torch.ones(1, frames, 2).double() if contacts is None else contacts,
        known=whole if known is None else known,
    )
