"""A refiner of a few kilobytes: untrained it changes nothing, with drawn weights it does."""

from functools import cache

import torch
from helpers import corpus
from tiny_files import make_card

from priors.refiner import LstmRefiner, RefinerConfig, RefinerNetwork

TINY = RefinerConfig(width=6, memory=5, lookahead=2, joints=("hips", "leftHand", "rightToes"))
walks = cache(corpus)


def network_of(config=TINY, *, trained=True, scale=1.0):
    """In float64, with the statistics of the walks; `trained` draws the last layer, which is zero at first."""
    features = walks().features
    reach = torch.linspace(-0.5, 0.5, 6 * len(config.joints))
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = RefinerNetwork(
            config,
            mean=features.mean(0),
            std=features.std(0).clamp(min=0.002),
            reach_mean=reach,
            reach_std=1 + reach.abs(),
        )
        if trained:
            torch.nn.init.normal_(network.last.weight, std=scale)
            torch.nn.init.normal_(network.last.bias, std=scale)
    return network.double().eval().requires_grad_(False)


def refiner_of(config=TINY, **how):
    card = make_card("refiner", config)
    return LstmRefiner("tiny", network_of(config, **how), card)
