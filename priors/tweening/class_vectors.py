"""Vectors of the classes of motion that training saw, as the style encoder makes them, for the card of a tweener."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mapctl import motion_dna, rotations
from mapctl.errors import RequestError
from mapctl.motion_dna import MotionDna
from mapctl.pose import BodyPose
from priors.training.corpus import Corpus
from priors.tweening.generator import GeneratorNetwork
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
