"""What a stitcher does between poses of unseen clips: how near it comes, how far its sides are apart, and how its
answers differ."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.kinematics import forward_kinematics
from mapctl.skeleton import CANONICAL
from priors.stitching.joining import Joined, join_sides
from priors.stitching.latents import DrawnLatents
from priors.stitching.network import StitcherNetwork
from priors.stitching.sides import Latents, count_made, walk_sides
from priors.training.augmentation.transition_windows import Known, Transition, TransitionWindows
from priors.training.devices import make_generator
from priors.training.recipes.stitcher_losses import interpolate

VALIDATED_GAPS = (5, 15, 30, 45)
"""Frames between the two poses."""
TEMPERATURES = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 2.75, 3.0)
"""Of draws, that are tried."""
_WINDOWS, _DRAWS = 96, 8
_DRAWN_GAP = 30
_AS_NEAR = 1.01  # of the least error of the best draw


@torch.no_grad()
def measure_transitions(network: StitcherNetwork, windows: TransitionWindows) -> dict[str, float]:
    """Measure the calm answer to two bare poses, and to a pose after 10 frames, as shares of the interpolation's mean
    distance of joints; and in a gap of 30 frames, in cm, errors of one draw and of the best of 8, and how far draws are
    apart. `apart` is the distance of the sides before they are joined, cm.
    """
    row: dict[str, float] = {}
    for name, known in (("bare", Known()), ("past", Known(before=10))):
        for gap in VALIDATED_GAPS:
            if not _has_room(network, windows, gap):
                continue
            truth = windows.draw(_WINDOWS, gap + 1, known, make_generator(gap))
            places, guess = _true_places(truth)
            joined = answer(network, truth, make_calm(network, truth))
            error = (place(joined) - places).norm(dim=-1).mean()
            row[f"{name}_{gap}"] = float(error / (guess - places).norm(dim=-1).mean())
            if known == Known():
                row[f"apart_{gap}_cm"] = 100 * float(joined.apart.mean())
            if known == Known() and gap == _DRAWN_GAP:
                row |= _measure_draws(network, truth, places)
    return row


@torch.no_grad()
def calibrate_temperature(network: StitcherNetwork, windows: TransitionWindows) -> float:
    """Return the largest standard deviation of draws' noise with which the best of eight still comes as near to the
    truth as with any, within a hundredth: as different as can be without wandering off. In gaps between bare poses,
    which count by their calm answer's error."""
    scores = torch.zeros(len(TEMPERATURES))
    for gap in VALIDATED_GAPS[1:]:
        if not _has_room(network, windows, gap):
            continue
        truth = windows.draw(_WINDOWS, gap + 1, Known(), make_generator(gap))
        places = _true_places(truth)[0]
        unit = (place(answer(network, truth, make_calm(network, truth))) - places).norm(dim=-1).mean()
        for number, temperature in enumerate(TEMPERATURES):
            errors = (_draw(network, truth, temperature) - places).norm(dim=-1).mean(dim=(2, 3))
            scores[number] += errors.amin(dim=0).mean() / unit
    return TEMPERATURES[int((scores <= _AS_NEAR * scores.min()).nonzero().max())]


def answer(network: StitcherNetwork, truth: Transition, latents: Latents) -> Joined:
    """Return what a stitcher makes of the ends of transitions."""
    ends = truth.ends()
    return join_sides(walk_sides(network, ends, truth.frames, latents))


def make_calm(network: StitcherNetwork, truth: Transition) -> DrawnLatents:
    """Make latents at the mean."""
    return DrawnLatents.calm(network.config, len(truth.features), count_made(network, truth.frames))


def place(joined: Joined) -> Float[Tensor, "batch frames joints 3"]:
    """Place the joints, metres, seen from the first pose."""
    return forward_kinematics(
        CANONICAL.offsets.to(joined.quats), CANONICAL.parents, joined.root_position, joined.quats
    )[0]


def _true_places(truth: Transition) -> tuple[Tensor, Tensor]:
    """Places of joints between the poses, true and interpolated."""
    bodies = interpolate(truth)
    true, guess = (body.joints_world()[:, :-1] for body in bodies)
    return true, guess


def _measure_draws(network: StitcherNetwork, truth: Transition, places: Tensor) -> dict[str, float]:
    draws = _draw(network, truth, float(network.temperature))
    errors = (draws - places).norm(dim=-1).mean(dim=(2, 3))
    pairs = [(one - other).norm(dim=-1).mean() for number, one in enumerate(draws) for other in draws[:number]]
    return {
        "draw_cm": 100 * float(errors[0].mean()),
        "best_cm": 100 * float(errors.amin(dim=0).mean()),
        "spread_cm": 100 * float(torch.stack(pairs).mean()),
    }


def _has_room(network: StitcherNetwork, windows: TransitionWindows, gap: int) -> bool:
    return gap + 13 <= max(windows.picker.lengths.tolist()) and gap + 1 <= network.config.longest


def _draw(
    network: StitcherNetwork, truth: Transition, temperature: float
) -> Float[Tensor, "draws batch frames joints 3"]:
    """Draw answers; those of one temperature have the noise of those of another, scaled."""
    generator, batch, made = make_generator(0), len(truth.features), count_made(network, truth.frames)
    latents = [DrawnLatents.sample(network.config, batch, made, generator) for _ in range(_DRAWS)]
    return torch.stack([place(answer(network, truth, each.scale(temperature))) for each in latents])
