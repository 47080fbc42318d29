"""How near a generator of long in-betweens comes to clips that training does not see, in one long gap of each."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from mapctl import kinematics
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion, interpolate_partial_motion
from mapctl.metrics.liveliness import NOTHING, Liveliness, measure_liveliness, see_from_hips
from mapctl.skeleton import CANONICAL
from priors.training.augmentation.pose_windows import PoseWindows, find_kind
from priors.training.corpus import Corpus
from priors.tweening.generator import GeneratorNetwork
from priors.tweening.keys import ToldParts, make_key_image

_VALIDATED_FRAMES = 192  # of the gap that is validated, 6.4 s; of shorter clips all but the ends
_SHORTEST_VALIDATED = 90
_VALIDATED_OF_KIND = 24


@torch.no_grad()
def measure_kinds(network: GeneratorNetwork, corpus: Corpus, kinds: Sequence[str]) -> dict[str, Any]:
    """By kind of clips with one long gap between two poses: error beside slerp's, cm, and speed, spread and jerk over
    mocap's, of sums."""
    windows = PoseWindows(corpus, kinds=kinds, evenness=1.0)
    kind_of = [find_kind(name, kinds) for name in corpus.names]
    row: dict[str, Any] = {}
    for kind, name in enumerate([*kinds, "other"]):
        found = [number for number, each in enumerate(kind_of) if each == kind]
        found = [one for one in found if int(windows.lengths[one]) >= _SHORTEST_VALIDATED + 2]
        if found:
            row |= {f"{name}_{what}": value for what, value in _measure_clips(network, windows, found).items()}
    return row


def _measure_clips(network: GeneratorNetwork, windows: PoseWindows, clips: Sequence[int]) -> dict[str, float]:
    sums = {"made": NOTHING, "slerp": NOTHING, "true": NOTHING}
    for number in clips[:_VALIDATED_OF_KIND]:
        frames = min(_VALIDATED_FRAMES + 2, int(windows.lengths[number]))
        motion = windows.at(torch.tensor([number]), torch.zeros(1, dtype=torch.long), frames, torch.ones(1))
        for name, found in measure_gap(network, motion).items():
            sums[name] += found
    made, slerp, true = (sums[name] for name in ("made", "slerp", "true"))
    return {
        "error_cm": made.error / made.count,
        "slerp_cm": slerp.error / slerp.count,
        "speed": made.speed / true.speed,
        "spread": made.spread / true.spread,
        "jerk": made.jerk / true.jerk,
    }


@torch.no_grad()
def measure_gap(network: GeneratorNetwork, motion: PartialMotion) -> dict[str, Liveliness]:
    """Measure what is made between the first and the last pose of one motion, beside slerp and the truth."""
    known = torch.zeros(motion.heading.shape, dtype=torch.bool)
    known[:, [0, -1]] = True
    image = make_key_image(motion, ToldParts.whole(known))
    made = network(image, torch.zeros(1, network.config.style)).turn_to_world(image)
    local = motion.local_matrices()
    true = see_from_hips(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])[0]
    shown = replace(motion, known=KnownParts.whole(known))
    guess = interpolate_partial_motion(shown, motion.quats[0, 0], 0.0).local_matrices()
    slerp = see_from_hips(kinematics.positions_from_matrices(CANONICAL, guess), guess[..., 0, :, :])[0]
    mine = see_from_hips(made.places, made.local_matrix[..., 0, :, :])[0]
    inside = ~known[0]
    return {
        name: measure_liveliness(seen, true, inside)
        for name, seen in (("made", mine), ("slerp", slerp), ("true", true))
    }
