"""`mapctl bench tweener`: which tables, one after the other."""

from collections.abc import Callable, Mapping

from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench import Tweener
from mapctl.commands.bench.output import print_parts
from mapctl.commands.bench.tweener import dna, gaps, keys, path, speed
from mapctl.errors import RequestError

PARTS: Mapping[str, Callable[[Tweener], Mapping[str, list[Row]]]] = {
    "path": path.measure,
    "gaps": gaps.measure,
    "spectrum": gaps.measure_spectrum,
    "keys": keys.measure_keys,
    "partial": keys.measure_partial,
    "apart": keys.measure_apart,
    "dna": dna.measure,
    "speed": speed.measure,
}
"""Tables by the name of a part."""


def run(table: Tweener) -> int:
    """Measure and print."""
    found: dict[str, list[Row]] = {}
    alone = bool(table.dna) and table.part == "all"
    for part in ["dna"] if alone else _parse_parts(table.part):
        found |= PARTS[part](table)
    return print_parts(table, found, markdown=table.markdown)


def _parse_parts(text: str) -> list[str]:
    """Names of parts in their order; RequestError for one that there is not."""
    named = list(PARTS) if text == "all" else [word.strip() for word in text.split(",")]
    unknown = [name for name in named if name not in PARTS]
    if unknown or not named:
        raise RequestError(f"--part takes {', '.join(PARTS)} or all; got {', '.join(unknown) or 'none'}")
    return [name for name in PARTS if name in named]
