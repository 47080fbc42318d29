"""What a wish costs the others: the shot solved again without it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from controllers.shots.request import ShotRequest
from controllers.shots.wishes import Wish
from mapctl.errors import RequestError

_NEGLIGIBLE = 0.5  # centimetres, degrees, centimetres a second


@dataclass(frozen=True)
class Price:
    """What others would gain without a wish."""

    wish: str
    """The wish."""
    gains: tuple[tuple[str, float, str], ...]
    """Name of each wish, what it would gain, and the unit of that number; what is negligible is left out."""

    @property
    def sentence(self) -> str:
        """Say it."""
        if not self.gains:
            return f"for {self.wish} no other gives up anything"
        given = ", ".join(f"{name} {gain:.1f} {unit}" for name, gain, unit in self.gains)
        return f"for {self.wish} others give up: {given}"

    def as_row(self) -> dict[str, Any]:
        """Return it as a report shows it."""
        return {"wish": self.wish, "gains": [list(gain) for gain in self.gains]}


def measure_prices(
    solve: Callable[[ShotRequest], tuple[Wish, ...]], request: ShotRequest, wishes: tuple[Wish, ...]
) -> tuple[Price, ...]:
    """Measure the price of every wish but the path, which stays: `solve` is called once for each, without it."""
    prices = []
    for name, without in _leave_out(request):
        found = {wish.name: wish for wish in solve(without)}
        gains = []
        for wish in wishes:
            other = found.get(wish.name)
            if other is not None and wish.name != name:
                gain = (other.got - wish.got) * (1 if wish.at_least else -1)
                if gain > _NEGLIGIBLE:
                    gains.append((wish.name, gain, wish.unit))
        prices.append(Price(name, tuple(gains)))
    return tuple(prices)


def _leave_out(request: ShotRequest) -> Iterator[tuple[str, ShotRequest]]:
    """Yield the request without each wish in turn; without what others need they are not requests."""
    parts: list[tuple[str, dict[str, Any]]] = []
    for kind in ("reaches", "poses", "looks"):
        keys = getattr(request, kind)
        for number, key in enumerate(keys):
            what = ", ".join(key.places) if kind == "reaches" else {"poses": "pose", "looks": "look"}[kind]
            parts.append((f"{what} at {key.seconds:g} s", {kind: keys[:number] + keys[number + 1 :]}))
    if request.obstacles:
        parts.append(("obstacles", {"obstacles": ()}))
    if request.others is not None:
        parts.append(("keep apart", {"others": None}))
    for name, field in (("stand at the start", "stand_at_start"), ("stand at the end", "stand_at_end")):
        if getattr(request, field):
            parts.append((name, {field: False}))
    for name, changed in parts:
        try:
            yield name, replace(request, **changed)
        except RequestError:
            continue
