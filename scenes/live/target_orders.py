"""Orders about what is dragged: what the chosen character reaches for and looks at, and what all walk round."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.numerics.checks import is_number
from scenes.live.actor import LiveActor
from scenes.live.inputs import DISC_RADII, HANDS, Place, parse_place
from scenes.live.targets import DraggableDisc, DraggableTarget, disc_before, place_before

_KNOWN: Mapping[str, Callable[[Any], bool]] = {
    "hand": lambda value: value is None or value in HANDS,
    "looks": lambda value: isinstance(value, bool),
    "target": lambda value: parse_place(value) is not None,
}
"""What a browser may send by the name of the order; anything else changes nothing."""


class LiveTargets:
    """TargetActions: a target for each character, of which the chosen one's is shown, and a disc for all of them."""

    def __init__(
        self,
        scene: viser.SceneApi,
        world: str,
        members: Sequence[LiveActor],
        chosen: Callable[[], LiveActor],
        enqueue: Callable[[Callable[[], None]], None],
    ):
        """Add the handles below the node `world`; `enqueue` runs an action on the show's own thread."""
        self._members, self._chosen, self._enqueue = members, chosen, enqueue
        self._target = DraggableTarget(scene, f"{world}/target", lambda place: self.aim(target=place))
        self._disc = DraggableDisc(scene, f"{world}/disc", self._move_disc)
        self.obstacles: tuple[Obstacle, ...] = ()

    def show(self) -> None:
        """Show the chosen character's target where it reaches for it or looks at it."""
        orders = self._chosen().orders
        self._target.show(orders.target if orders.hand or orders.looks else None)

    def aim(self, **changes: Any) -> None:
        """See TargetActions; a target that is new appears before the character."""

        def aimed() -> None:
            member = self._chosen()
            known = {name: value for name, value in changes.items() if _KNOWN[name](value)}
            member.orders = replace(member.orders, **known)
            if member.orders.target is None:
                member.orders = replace(member.orders, target=_place_target(member))
            member.aim(self.obstacles)
            self.show()

        self._enqueue(aimed)

    def put_disc(self, radius: float | None) -> None:
        """See TargetActions; a disc that is new appears in the chosen character's way."""

        if radius is not None and not (is_number(radius) and DISC_RADII[0] <= radius <= DISC_RADII[1]):
            return

        def put() -> None:
            if radius is None or not self.obstacles:
                self.set_disc(None if radius is None else self._place_disc(radius))
            else:
                self.set_disc(replace(self.obstacles[0], radius=radius))

        self._enqueue(put)

    def bring(self) -> None:
        """See TargetActions."""

        def brought() -> None:
            if self.obstacles:
                self.set_disc(self._place_disc(self.obstacles[0].radius or 0.0))
            member = self._chosen()
            member.orders = replace(member.orders, target=_place_target(member))
            member.aim(self.obstacles)
            self.show()

        self._enqueue(brought)

    def _move_disc(self, place: Place) -> None:
        def moved() -> None:
            if self.obstacles:
                self.set_disc(replace(self.obstacles[0], place=(place[0], place[2])))

        self._enqueue(moved)

    def set_disc(self, disc: Obstacle | None) -> None:
        """Have everybody walk round a disc, or round nothing; for the show's own thread."""
        self.obstacles = () if disc is None else (disc,)
        self._disc.show(disc)
        for member in self._members:
            member.aim(self.obstacles)

    def _place_disc(self, radius: float) -> Obstacle:
        member = self._chosen()
        return disc_before(member.place, member.orders.heading, radius)


def _place_target(member: LiveActor) -> Place:
    return place_before(member.place, member.orders.heading, hand=member.orders.hand)
