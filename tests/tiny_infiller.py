"""An infiller of a few kilobytes: it proposes about the T-pose, the farther from it the wider its weights are drawn."""

from pathlib import Path

import torch
from tiny_files import make_card, save_model

from mapctl import kinematics
from mapctl.inbetweening import PositionImage
from mapctl.skeleton import CANONICAL
from priors.infiller import ConvInfiller, InfillerConfig, InfillerNetwork

CONFIG = InfillerConfig(widths=(2, 2, 2, 2, 2))


def network(*, drawn: float = 0.0, seed: int = 0, config: InfillerConfig = CONFIG) -> InfillerNetwork:
    """Weights of the last layer are drawn with this share of their usual spread."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = InfillerNetwork(config).requires_grad_(False)
    rest = torch.tensor([[0.0, 0.0, 0.0, 1.0]]).expand(CANONICAL.num_joints, 4)
    result.std.fill_(0.1)
    height = torch.tensor([0.0, 0.95, 0.0])
    result.mean.copy_(kinematics.forward_kinematics(CANONICAL.offsets.float(), CANONICAL.parents, height, rest)[0])
    result.net.up_two[-1].weight.mul_(drawn)
    return result.eval()


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
