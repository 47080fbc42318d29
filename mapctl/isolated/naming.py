"""Names in files of characters: made unique, and the one that is meant among them."""

from collections.abc import Sequence

_MAX_NAMED = 8


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


def find_name(file: str, names: Sequence[str], wanted: str | None, what: str, *, several: bool) -> int:
    """Return the index of the wanted name, or of the only or first one; `what` is `armature` or `animation`.

    LookupError lists the names where none is the wanted one, or several are there and one must be chosen: FILE#NAME.
    """
    listed = ", ".join(repr(name) for name in names[:_MAX_NAMED]) + (" ..." if len(names) > _MAX_NAMED else "")
    example = f"{file}#{names[0] if what == 'armature' else '/' + names[0]}" if names else ""
    if wanted is not None:
        if wanted in names:
            return names.index(wanted)
        raise LookupError(f"has no {what} {wanted!r}; it has {listed or 'none'}")
    if len(names) > 1 and not several:
        raise LookupError(f"has {len(names)} {what}s: {listed}; choose one, as {example}")
    return 0
