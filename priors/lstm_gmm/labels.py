"""Labels of clips (gait, style), read from their names: what a density can be conditioned on."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.metrics.gait import CHANGES, PACES, label_pace

_OTHER_SIDE = {"left": "right", "right": "left"}


@dataclass(frozen=True, eq=False)
class Labels:
    """Which labels hold for which clip."""

    names: tuple[str, ...]
    """Labels as `group=value`, sorted: gait=run, style=active."""
    held: Float[Tensor, "clips labels"]
    """1 where a label holds."""

    @staticmethod
    def none(clips: int) -> "Labels":
        """Return no labels, for so many clips."""
        return Labels((), torch.zeros(clips, 0))

    @property
    def groups(self) -> Float[Tensor, "groups labels"]:
        """1 where a label belongs to a group."""
        kinds = [name.split("=")[0] for name in self.names]
        return torch.tensor([[float(kind == group) for kind in kinds] for group in dict.fromkeys(kinds)])

    @property
    def mirrored(self) -> list[int]:
        """Index of each label's mirror image: left and right are swapped where both are known."""
        swapped = [re.sub("left|right", lambda side: _OTHER_SIDE[side[0]], name) for name in self.names]
        return [self.names.index(other) if other in self.names else i for i, other in enumerate(swapped)]

    def renamed(self, names: tuple[str, ...]) -> "Labels":
        """Return the clips under other labels; a label that only one of both knows holds for none."""
        held = torch.zeros(len(self.held), len(names))
        for column, name in enumerate(names):
            if name in self.names:
                held[:, column] = self.held[:, self.names.index(name)]
        return Labels(names, held)


def read_name(clip: str, pattern: str) -> set[str]:
    """Read the labels that one clip's name tells; none where the pattern is empty or is not found in it."""
    return _parse_match(re.search(pattern, clip)) if pattern else set()


def read(clips: Sequence[str], pattern: str) -> Labels:
    """Read labels from clips' names by the named groups of a regular expression; an empty pattern reads none.

    RequestError where it is no regular expression, has no named group or matches no clip.
    """
    if not pattern:
        return Labels.none(len(clips))
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise RequestError(f"labels must be a regular expression, got {pattern!r} ({error})") from error
    if not compiled.groupindex:
        raise RequestError(f"labels need named groups as in (?P<style>[a-z]+), got {pattern!r}")
    found = [_parse_match(compiled.search(name)) for name in clips]
    names = tuple(sorted(set().union(*found)))
    if not names:
        raise RequestError(f"the labels {pattern!r} match no clip, such as {clips[0]!r}")
    return Labels(names, torch.tensor([[float(name in clip) for name in names] for clip in found]))


def _parse_match(match: re.Match[str] | None) -> set[str]:
    if match is None:
        return set()
    return {f"{group}={value}" for group, value in match.groupdict().items() if value}


PACE_LABELS = tuple(map(label_pace, PACES))
"""Labels of PACES."""


def read_pace_rates(holds: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    """Read changes a second from one pace to another, by both paces, from what a card says that its clips hold. None of
    a pace that they hold for less than the 0.3 s to which a card rounds."""
    minutes = holds["minutes by pace"]
    return {
        (before, after): holds[name] / (60 * minutes[before])
        for (before, after), name in CHANGES.items()
        if minutes[before] > 0 and minutes[after] > 0
    }
