"""Motion on the user's own rig: whose bones the solver uses, and the way from canonical joints to the rig."""

from dataclasses import dataclass, replace

from controllers.common.character import Character
from mapctl import retarget
from mapctl.commands.shared import inputs
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.carry import RiggedCharacter


@dataclass(frozen=True, eq=False)
class OutputCharacter(Character):
    """Whose bones move, and the rig that the motion is written on."""

    rigmap: RigMap | None = None
    """The way back to the rig; None for the canonical skeleton."""
    source: object | None = None
    """Layout and unit of the rig's clip, which the result is written in."""

    def on_rig(self, motion: Motion) -> Motion:
        """A canonical motion of this person on the rig; fingers and whatever else is not canonical rest."""
        if self.rigmap is None:
            return motion
        return replace(retarget.from_canonical(motion, self.rigmap), source=self.source)


def read_character(text: str) -> OutputCharacter:
    """The person of a --rig option: canonical, of a clip's skeleton, or with canonical bones on a preset's joints."""
    if text == "canonical":
        return OutputCharacter()
    body = RiggedCharacter.of(*inputs.read_rig_clip(text))[1]
    return OutputCharacter(body.leveled, float(body.stance.toe_height.mean()), body.leveled_map, body.source)
