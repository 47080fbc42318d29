"""The tables of the documentation: the command that makes each."""

from collections.abc import Sequence
from pathlib import Path

from mapctl.errors import RequestError

_DATA = "DATA"
_PLAN = {
    "speed": "speed",
    "follow": "follow --data DATA --baselines free/locomotion",
    "ablation": "ablation",
    "ablation-shots": "ablation --shots 40",
    "steer": "steer",
    "steer-free": "steer --prior free/locomotion",
    "steer-targets": "steer --targets --count 24",
    "live": "live --find-most --minutes 0.34",
    "live-orders": "live --orders 3 --minutes 5",
    "generation": "generation --data DATA",
    "free-run": "free-run",
    "free-run-general": "free-run --prior general",
    "free-run-free": "free-run --prior free/locomotion",
    "shots": "shots --count 40 --data DATA",
    "shots-corners": "shots --corners --seeds 4",
    "transitions": "transitions --data DATA --count 60 --stitcher stitcher",
    "transitions-bare": "transitions --data DATA --count 60 --stitcher stitcher --past 1",
    "transitions-partial": "transitions --data DATA --count 30 --partial-keys --raw --stitcher stitcher",
    "tween": "tween --data DATA --count 40",
    "tweener-gaps": "tweener --data DATA --part gaps --baselines transformer --seconds 6.4 --count 60",
    "tweener-gaps-3s": "tweener --data DATA --part gaps --baselines transformer --seconds 3 --count 40",
    "tweener-partial": "tweener --data DATA --part partial --count 5 --raw",
    "tweener-keys": "tweener --data DATA --part keys --baselines transformer --count 60 --sequences 20",
    "tweener-apart": "tweener --data DATA --part apart --baselines transformer --sequences 40",
    "tweener-speed": "tweener --data DATA --part speed --count 20",
    "tweener-dna": "tweener --data DATA --dna 12 --raw",
    "tweener-path": "tweener --data DATA --part path",
    "timing": "timing --data DATA --count 1000",
}
"""Words after `mapctl bench`, by table."""


def list_tables(only: str) -> list[str]:
    """List the tables that are asked for, in the plan's order; RequestError names those that there are."""
    asked = [name.strip() for name in only.split(",") if name.strip()]
    unknown = [name for name in asked if name not in _PLAN]
    if unknown:
        raise RequestError(f"there is no table {unknown[0]!r}; there are {', '.join(_PLAN)}")
    return [name for name in _PLAN if not asked or name in asked]


def list_words(table: str, data: Path | str = _DATA) -> Sequence[str]:
    """List the words of a table's command after `mapctl`, with the folder of clips put in."""
    return ["bench", *(str(data) if word == _DATA else word for word in _PLAN[table].split())]
