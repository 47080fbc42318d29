"""Motion on the user's own rig: whose bones the solver uses, and the way from canonical joints to the rig."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.shared import options

if TYPE_CHECKING:
    from mapctl.motion import Motion
    from mapctl.retarget import RigMap
    from mapctl.skeleton import Skeleton

OutRig = Annotated[str, arg(metavar="canonical|PRESET|FILE.toml|CLIP")]
"""Type of the option."""


@dataclass(frozen=True, eq=False)
class Character:
    """Who is to move."""

    skeleton: "Skeleton"
    """Canonical names and tree with the person's bones."""
    toe_rest_height: float
    """Of the person's toe joints while the foot stands flat, metres."""
    rigmap: "RigMap | None" = None
    """The way back to the rig; None for the canonical skeleton."""
    source: object | None = None
    """Layout and unit of the rig's clip, which the result is written in."""

    def on_rig(self, motion: "Motion") -> "Motion":
        """A canonical motion of this person on the rig; fingers and whatever else is not canonical rest."""
        if self.rigmap is None:
            return motion
        from mapctl import retarget

        return replace(retarget.from_canonical(motion, self.rigmap), source=self.source)


def read_character(text: str) -> Character:
    """The person of a --rig option: canonical, of a clip's skeleton, or with canonical bones on a preset's joints."""
    from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT

    if text == "canonical":
        return Character(CANONICAL, TOE_REST_HEIGHT)
    from mapctl.retarget.carry import RiggedCharacter

    body = RiggedCharacter.of(*options.read_rig_clip(text))[1]
    return Character(body.leveled, float(body.stance.toe_height.mean()), body.leveled_map, body.source)
