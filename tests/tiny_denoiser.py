"""A denoiser of a few kilobytes: untrained it smooths, with drawn weights it does something else with what it sees."""

from pathlib import Path

import torch
from tiny_files import make_card, save_model

from controllers.common.map_refinement import RefinementSettings
from controllers.denoising.denoise import DenoiseSettings
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from priors.denoiser import ConvDenoiser, DenoiserConfig, DenoiserNetwork

QUICK = DenoiseSettings(
    refinement=RefinementSettings(lbfgs=LbfgsSettings(max_iterations=4), budget=Budget(evaluations=4))
)
"""Settings of a denoising that searches little."""
CONFIG = DenoiserConfig(width=8, dilations=(1, 2))


def network(*, drawn: float = 0.0, seed: int = 0, config: DenoiserConfig = CONFIG) -> DenoiserNetwork:
    """Weights of the last layers are drawn with this spread; untrained they are nil."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = DenoiserNetwork(config)
        if drawn:
            for layer in (result.last, *(block.across for block in result.blocks)):
                for parameter in layer.parameters():
                    torch.nn.init.normal_(parameter, std=drawn)
    return result.eval().requires_grad_(False)


def tiny_denoiser(*, drawn: float = 0.0, seed: int = 0) -> ConvDenoiser:
    """As the controllers take it."""
    return ConvDenoiser("tiny", network(drawn=drawn, seed=seed), make_card("denoiser", CONFIG))


def save_tiny_denoiser(path: Path, *, drawn: float = 0.0) -> Path:
    """Write the weights and the card; returns the path for --denoiser."""
    return save_model(tiny_denoiser(drawn=drawn), path)
