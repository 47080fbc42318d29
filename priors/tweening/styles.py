"""Styles: what a generator is told of how to move, by poses of a motion (its DNA) or by the name of a class.

The classes of a set of weights are in its card: what the style encoder made of clips of training, as vectors. No pose
of mocap is kept.
"""

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import CheckpointError, RequestError
from mapctl.motion_dna import MotionDna
from priors.checkpoints import Card
from priors.tweening.generator import StyleEncoder

LABELS = r"^.*dataset-\d+_([^_/]+)_[^/]*$|^(?:.*/)?([^/]+/[^/]+)/[^/]+$|^([^/]+)/[^/]+$|^(.*?)[\d_ -]*\.[^.]*$"
"""Classes of clips by their names, unless another pattern is given: what Bandai Namco call the content; for others the
folder, two deep; without folders the file's name less its number."""
_FIELD = "classes"  # of a card's data


@dataclass(frozen=True, eq=False)
class Style:
    """How to move."""

    name: str
    """What it is of, for notes: files or classes."""
    vector: Float[Tensor, " style"]
    """What the style encoder makes of it."""
    poses: Float[Tensor, "poses joints 3"] | None = None
    """Poses of it, as `MotionDna` holds them; None for a class."""


def mix_styles(styles: Sequence[Style]) -> Style:
    """Mix styles, each as much as the others; RequestError for none."""
    if not styles:
        raise RequestError("a style needs at least one clip or class")
    poses = [style.poses for style in styles if style.poses is not None]
    return Style(
        " and ".join(style.name for style in styles),
        torch.stack([style.vector for style in styles]).mean(dim=0),
        torch.cat(poses) if poses else None,
    )


def draw_style(
    styles: Sequence[Style],
    number: int,
    encode: Callable[[MotionDna, str], Style],
    *,
    order: Sequence[int],
    generator: torch.Generator,
) -> Style:
    """Draw the style of the variation of this number: the styles one after the other in this order, and then again some
    poses of each, drawn anew, or a class mixed with another. RequestError for one class alone, which leaves no choice.
    """
    base = styles[order[number % len(styles)]]
    if number < len(styles) and len(styles) > 1:
        return base
    if base.poses is not None:
        count = max(1, len(base.poses) // 2)
        chosen = torch.randperm(len(base.poses), generator=generator)[:count]
        return encode(MotionDna(base.poses[chosen]), f"{base.name}, {count} of its poses")
    others = [style for style in styles if style is not base]
    if not others:
        raise RequestError(f"the class {base.name} alone leaves nothing to vary; name more classes or motion files")
    other = others[int(torch.randint(len(others), (), generator=generator))]
    share = 0.3 + 0.4 * float(torch.rand((), generator=generator))
    return Style(f"{base.name} and {other.name}", torch.lerp(base.vector, other.vector, share), other.poses)


def find_class(clip: str, labels: str = LABELS) -> str | None:
    """Find the class of a clip by its name: what the first group of the pattern that took part matched, folders joined
    by a hyphen; None where the pattern is not found. RequestError for a pattern without a group, or that is none."""
    try:
        pattern = re.compile(labels)
    except re.error as error:
        raise RequestError(f"--labels must be a regular expression, got {labels!r} ({error})") from error
    if not pattern.groups:
        raise RequestError(f"--labels needs a group as in _([a-z-]+)_, which is the class; got {labels!r}")
    found = pattern.search(clip)
    told = next((group for group in found.groups() if group), "") if found else ""
    return told.replace("/", "-") or None


@torch.no_grad()
def encode_classes(encoder: StyleEncoder, classes: Mapping[str, Sequence[MotionDna]]) -> dict[str, Any]:
    """Encode classes for the data of a card: by name the number of clips, and the mean of their vectors."""
    encoded = {}
    for name in sorted(classes):
        each = torch.stack([encoder(dna.poses[None])[0] for dna in classes[name]])
        half = each.mean(dim=0).numpy().astype("<f2")
        encoded[name] = {"clips": len(each), "vector": base64.b64encode(half.tobytes()).decode("ascii")}
    return {_FIELD: encoded}


def read_classes(card: Card, size: int) -> dict[str, Style]:
    """Read the classes of a card by name, none of an older one; CheckpointError where they are not of this size."""
    styles = {}
    for name, told in card.data.get(_FIELD, {}).items():
        try:
            vector = np.frombuffer(base64.b64decode(told["vector"], validate=True), "<f2").astype(np.float32)
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"the class {name} in the card holds no vector ({error})") from error
        if len(vector) != size or not np.isfinite(vector).all():
            raise CheckpointError(f"the class {name} in the card must hold {size} finite numbers, got {len(vector)}")
        styles[name] = Style(name, torch.from_numpy(vector))
    return styles


def count_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the classes in a card's data by how many clips each was made of, for people to read."""
    if _FIELD not in data:
        return dict(data)
    return {**data, _FIELD: {name: told["clips"] for name, told in data[_FIELD].items()}}


def pick_class(classes: Mapping[str, Style], name: str) -> Style:
    """Pick a class; RequestError, naming the nearest, for one that there is not."""
    if name in classes:
        return classes[name]
    if not classes:
        raise RequestError(f"there is no file {name}, and these weights know no classes of motion")
    near = get_close_matches(name, classes, n=1, cutoff=0.0)[0]
    raise RequestError(
        f"there is no file and no class {name}; the nearest class is {near} (`mapctl info tweener` lists all)"
    )
