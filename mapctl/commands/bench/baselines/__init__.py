"""Models that are measured beside the one that a table is about: names, what they may not have seen, rows."""

import re
from collections.abc import Callable, Mapping, Sequence

import priors
from controllers.benchmarks.shared.tables import Row
from mapctl.errors import RequestError
from priors.checkpoints import Card
from priors.lstm_gmm.density import LstmGmmDensity
from priors.refiner.network import LstmRefiner


def list_models(own: str, baselines: str) -> list[str]:
    """The model that a table is about, then those to compare; RequestError for one that is named twice."""
    names = [own, *(name.strip() for name in baselines.split(",") if name.strip())]
    twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
    if twice is not None:
        raise RequestError(f"--baselines are other models than {own}, each named once; got {twice} twice")
    return names


def find_held_out(cards: Mapping[str, Card], clips: str = "") -> Mapping[str, Sequence[str]]:
    """Find the clips that the model of the first card kept from training, of which the paths hold a regular expression;
    RequestError where another has seen some, and where there are none."""
    kept = next(iter(cards.values())).data.get("held_out", {})
    try:
        held_out = {part: [name for name in names if re.search(clips, name)] for part, names in kept.items()}
    except re.error as error:
        raise RequestError(f"--clips is no regular expression: {error}") from error
    if clips and not any(held_out.values()):
        raise RequestError(f"none of the clips that were kept for measuring has a path with {clips!r}")
    for name, card in cards.items():
        check_unseen(name, card, held_out)
    return held_out


def check_unseen(name: str, card: Card, held_out: Mapping[str, Sequence[str]]) -> None:
    """RequestError where a model's training saw clips that are kept for measuring: all but those that it kept itself,
    and those that its regular expression for paths leaves out."""
    own = {clip for clips in card.data.get("held_out", {}).values() for clip in clips}
    trained_on = str(card.data.get("match") or "")
    seen = [clip for clips in held_out.values() for clip in clips if clip not in own and re.search(trained_on, clip)]
    if seen:
        raise RequestError(
            f"{name} was trained on {seen[0]}, which is kept for measuring; train it with that seed on the same files"
        )


def load_generators(
    own: str, baselines: str
) -> tuple[LstmGmmDensity, Mapping[str, Sequence[str]], dict[str, LstmGmmDensity], dict[str, LstmRefiner]]:
    """Load the density that a table is about, with the clips it kept from training, and by name the other densities and
    refiners to compare; RequestError where a density has seen some of these clips."""
    prior, others = priors.load(own), list_models(own, baselines)[1:]
    held_out = prior.card.data.get("held_out", {})
    refiners = [name for name in others if priors.find_kind(name) == "refiner"]
    densities = {name: priors.load(name) for name in others if name not in refiners}
    for name, density in densities.items():
        check_unseen(name, density.card, held_out)
    return prior, held_out, densities, {name: priors.load_refiner(name) for name in refiners}


def measure_each(names: Sequence[str], measure: Callable[[str], Sequence[Row]]) -> list[Row]:
    """The rows of each model, which name it: those that tell of the same follow each other. One alone is not named."""
    found = {name: measure(name) for name in names}
    if len(found) == 1:
        return list(found[names[0]])
    named = [[{"model": name, **row} for row in rows] for name, rows in found.items()]
    if len({len(rows) for rows in named}) > 1:  # a model for which something could not be measured
        return [row for rows in named for row in rows]
    return [row for rows in zip(*named, strict=True) for row in rows]
