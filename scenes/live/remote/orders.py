"""Orders that other programs send over OSC, obeyed as those of the page are: within the same limits."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError, RequestError
from mapctl.streaming.orders import HANDS, Order, keep_latest, read_order
from mapctl.streaming.protocols import MessageSource
from scenes.live.inputs import DISC_RADII, WITHIN, Refusal, SteeringInputs, parse_place

_WITHIN_SECONDS = 2.0  # in which somebody is sent to a place, unless the order says
_SAY_SECONDS = 2.0  # between two lines on the console, however many orders there are
_SAY_DROPPED_SECONDS = 60.0  # between two lines about packets that make no sense
_AIMS = (*HANDS, "look")
_JOURNEYS = ("place", "path")
_FOR_EVERYBODY = ("reset", "pause", "disc")


@runtime_checkable
class Member(Protocol):
    """A character that has orders."""

    orders: SteeringInputs
    """Orders that hold."""


MemberT = TypeVar("MemberT", bound=Member)
MemberContraT = TypeVar("MemberContraT", bound=Member, contravariant=True)


@runtime_checkable
class RemoteStage(Protocol[MemberContraT]):
    """What orders act on."""

    def change(self, member: MemberContraT, changes: Mapping[str, Any]) -> list[Refusal]:
        """Change a character's orders by name, within the limits, and have it obey; return what could not be."""
        ...

    def aim(self, member: MemberContraT) -> None:
        """Have a character reach for and look at what its orders say."""
        ...

    def go(self, member: MemberContraT, place: tuple[float, float], within: float, facing: float | None) -> None:
        """Send a character to a place, metres, in so many seconds, facing so, radians."""
        ...

    def walk(self, member: MemberContraT, points: Sequence[tuple[float, float]]) -> None:
        """Have a character walk along points, metres."""
        ...

    def set_disc(self, disc: Obstacle | None) -> None:
        """Have everybody walk round a disc, or round nothing."""
        ...

    def set_paused(self, paused: bool) -> None:
        """Stop everybody, or go on."""
        ...

    def restart(self) -> None:
        """Restart everybody."""
        ...


class RemoteOrders(Generic[MemberT]):
    """Reads what other programs send, and has it obeyed: of several orders of a kind the last that came."""

    def __init__(
        self, source: MessageSource, stage: RemoteStage[MemberT], members: Sequence[MemberT], *, groups: Sequence[str]
    ):
        """`groups` are the groups of the prior's labels."""
        self._source, self._stage, self._members, self._groups = source, stage, members, groups
        self._noted, self._said_at, self._notes = list[str](), -math.inf, 0
        self._dropped, self._dropped_said_at = 0, -math.inf

    def obey(self) -> None:
        """Obey what came since the last time."""
        orders = keep_latest(self._read())
        for order in orders:
            if order.name in _FOR_EVERYBODY:
                self._try(self._direct, order)
        for number in sorted({order.character for order in orders}):
            mine = [order for order in orders if order.character == number]
            member = self._members[number]
            self._steer(member, [o for o in mine if o.name not in (*_AIMS, *_JOURNEYS, *_FOR_EVERYBODY)])
            self._aim(member, [o for o in mine if o.name in _AIMS])
            for order in mine:
                if order.name in _JOURNEYS:
                    self._try(self._send, order)

    def report(self, now: float) -> str | None:
        """Return a line about orders that could not be obeyed, now and then; `now` is a value of time.perf_counter."""
        dropped = self._source.dropped - self._dropped
        if dropped and now - self._dropped_said_at >= _SAY_DROPPED_SECONDS:
            self._dropped, self._dropped_said_at = self._source.dropped, now
            return f"OSC: {self._source.fault}" + (f" (and {dropped - 1} more)" if dropped > 1 else "")
        if not self._notes or now - self._said_at < _SAY_SECONDS:
            return None
        more = f" (and {self._notes - 1} more)" if self._notes > 1 else ""
        self._said_at, self._notes = now, 0
        return f"OSC: {self._noted.pop()}{more}"

    def _read(self) -> list[Order]:
        found: list[Order] = []
        for message in self._source.poll():
            try:
                found.append(read_order(message, characters=len(self._members), groups=self._groups))
            except RequestError as error:
                self._note(str(error))
        return found

    def _steer(self, member: MemberT, orders: Sequence[Order]) -> None:
        changes: dict[str, Any] = {}
        for order in orders:
            if order.word is not None:
                changes["labels"] = {**changes.get("labels", {}), order.name: order.word}
            elif order.name == "stop":
                changes["speed"] = 0.0
            else:
                changes[order.name] = _wrap(order) if order.name in ("heading", "facing") else _first(order)
        if changes:
            for refusal in self._stage.change(member, changes):
                self._note(refusal.text)

    def _aim(self, member: MemberT, orders: Sequence[Order]) -> None:
        for order in orders:
            place = parse_place(order.numbers) if order.numbers else None
            if order.numbers and place is None:
                self._note(f"{order.name}: the place is too far away")
                continue
            held = member.orders
            if order.name == "look":
                member.orders = replace(held, look_at=place, looks=False)
            else:
                hand = HANDS[order.name]
                reach = {side: at for side, at in {**held.reach, hand: place}.items() if at is not None}
                member.orders = replace(held, reach=reach, hand=None if held.hand == hand else held.hand)
        if orders:
            self._stage.aim(member)

    def _send(self, order: Order) -> None:
        member, numbers = self._members[order.character], order.numbers
        ground = numbers if order.name == "path" else numbers[:2]
        points = list(zip(ground[::2], ground[1::2], strict=True))
        if any(parse_place((x, 0.0, z)) is None for x, z in points):
            raise RequestError(f"{order.name}: the place is too far away")
        if order.name == "path":
            self._stage.walk(member, points)
            return
        asked = numbers[2] if len(numbers) > 2 else _WITHIN_SECONDS
        within = min(WITHIN[1], max(WITHIN[0], asked))
        if within != asked:
            self._note(f"place: {asked:g} s became {within:g}; it can be {WITHIN[0]:g} to {WITHIN[1]:g}")
        facing = math.radians(math.remainder(numbers[3], 360)) if len(numbers) > 3 else None
        self._stage.go(member, points[0], within, facing)

    def _direct(self, order: Order) -> None:
        if order.name == "reset":
            self._stage.restart()
        elif order.name == "pause":
            self._stage.set_paused(_first(order) != 0)
        elif order.numbers:
            x, z, radius = order.numbers
            if not DISC_RADII[0] <= radius <= DISC_RADII[1] or parse_place((x, 0.0, z)) is None:
                raise RequestError(f"disc: the radius must be {DISC_RADII[0]:g} to {DISC_RADII[1]:g} m, the place near")
            self._stage.set_disc(Obstacle((x, z), radius))
        else:
            self._stage.set_disc(None)

    def _try(self, action: Any, order: Order) -> None:
        try:
            action(order)
        except MapctlError as error:
            self._note(str(error))

    def _note(self, text: str) -> None:
        self._notes += 1
        self._noted = [text]


def _first(order: Order) -> float | None:
    return order.numbers[0] if order.numbers else None


def _wrap(order: Order) -> float | None:
    """Return an angle within half a turn either way, which means the same."""
    return math.remainder(order.numbers[0], 360) if order.numbers else None
