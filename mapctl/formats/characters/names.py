"""Names of joints and armatures, made unique: files of characters need not have them so."""

from collections.abc import Sequence


def make_unique(names: Sequence[str]) -> list[str]:
    """Return the names in order, each later one of several alike with `_2`, `_3`, ..."""
    taken: set[str] = set()
    found = []
    for name in names:
        candidate, number = name, 2
        while candidate in taken or (candidate != name and candidate in names):
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate)
        found.append(candidate)
    return found
