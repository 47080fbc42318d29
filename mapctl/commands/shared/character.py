"""The character of a --rig option."""

from controllers.common.character import Character
from mapctl.commands.shared import inputs
from mapctl.retarget.carry import RiggedCharacter


def read_character(text: str) -> Character:
    """Read the character: canonical, of a clip's skeleton, or with canonical bones on a preset's joints."""
    if text == "canonical":
        return Character()
    body = RiggedCharacter.of(*inputs.read_rig_clip(text))[1]
    return Character(body.leveled, float(body.stance.toe_height.mean()), body.leveled_map, body.source)
