"""Classes of motion for trained weights: `python -m priors.tweening.class_vectors --data DATA --weights RUN`.

It reads the clips that training saw and writes what the style encoder makes of each class into the card, as the end of
`mapctl train tweener` does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import tyro

from mapctl import motion_dna, rotations
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_text
from mapctl.motion_dna import MotionDna
from mapctl.pose import BodyPose
from priors import checkpoints
from priors.training.corpus import Corpus, read_corpus
from priors.tweening.generator import GeneratorConfig, GeneratorNetwork
from priors.tweening.styles import LABELS, encode_classes, find_class

CLIPS_OF_CLASS = 24
"""Clips of a class that its vector is the mean of, at most: evenly among all of them by name."""


def compute_classes(network: GeneratorNetwork, corpus: Corpus, labels: str = LABELS) -> dict[str, Any]:
    """Compute the classes of a corpus, for the data of a card; RequestError for labels of one's own that no clip
    has."""
    return encode_classes(network.style, collect_dna(corpus, labels))


def collect_dna(corpus: Corpus, labels: str = LABELS) -> Mapping[str, Sequence[MotionDna]]:
    """Collect the poses of clips by class."""
    clips = corpus.clips()
    return {
        name: [_take_poses(clips[numbers[at]]) for at in _spread(len(numbers))]
        for name, numbers in group_clips(corpus.names, labels).items()
    }


def group_clips(names: Sequence[str], labels: str = LABELS) -> dict[str, list[int]]:
    """Group clips, by number, by class; RequestError for labels of one's own that no clip has."""
    members: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        if (found := find_class(name, labels)) is not None:
            members.setdefault(found, []).append(number)
    if not members and labels != LABELS:
        raise RequestError(f"--labels {labels!r} matches no clip, such as {names[0]!r}")
    return members


def _spread(count: int) -> list[int]:
    """Spread so many numbers as clips are taken evenly over a count."""
    taken = min(count, CLIPS_OF_CLASS)
    return [number * count // taken for number in range(taken)]


def _take_poses(features: torch.Tensor) -> MotionDna:
    pose = BodyPose.of_features_in_place(features)
    return motion_dna.of_rotations(rotations.from_rotation_vector(pose.rotation_vectors))


def main(data: Path, weights: str, *, labels: str = LABELS, skip_first: bool = True, cache: Path | None = None) -> None:
    """Write the classes into the card of trained weights, over those that it holds.

    Args:
        data: Folder of .bvh files that was trained on.
        weights: File or run folder of the tweener.
        labels: Regular expression whose first group in a clip's name is its class.
        skip_first: Leave out frame 0 of every clip (the T-pose of CMU takes).
        cache: Folder for the clips as features, which take minutes to read; beside the weights if not given.
    """
    path = checkpoints.locate(weights)
    with checkpoints.open_checkpoint(weights, "tweener") as (tensors, card):
        network = GeneratorNetwork(GeneratorConfig.of_card(card.config))
        network.load_state_dict(tensors)
    held_out = {name for part in card.data.get("held_out", {}).values() for name in part}
    kept = path.parent / "cache" if cache is None else cache
    corpus = read_corpus(data, match=card.data.get("match", ""), cache=kept, skip_first=skip_first)
    seen = [number for number, name in enumerate(corpus.names) if name not in held_out]
    classes = compute_classes(network.eval(), corpus.subset(seen), labels)
    card = replace(card, data={**card.data, **classes})
    file = path.with_suffix(".json")
    write_text(file, checkpoints.encode_json(vars(card), file, indent=1))


if __name__ == "__main__":
    tyro.cli(main)
