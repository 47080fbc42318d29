"""The characters of --rig and --character: the body that moves, and the one that is drawn.

What reads other bodies than the canonical one is imported when there is one.
"""

from typing import TYPE_CHECKING

from controllers.common.character import Character
from mapctl.commands.shared import inputs
from mapctl.commands.shared.options import ReadOptions

if TYPE_CHECKING:
    from mapctl.retarget.carry import RiggedCharacter
    from scenes.drawn_character import DrawnCharacter


def read_character(text: str, options: ReadOptions | None = None) -> Character:
    """Read the character: canonical, of a clip's skeleton, or with canonical bones on a preset's joints."""
    if text == "canonical":
        return Character()
    return as_character(read_rigged(text, options))


def read_rigged(text: str, options: ReadOptions | None = None) -> "RiggedCharacter":
    """Read the rig and stance of a clip, a preset or a rig file."""
    from mapctl.retarget.carry import RiggedCharacter

    return RiggedCharacter.of(*inputs.read_rig_clip(text, options))[1]


def as_character(body: "RiggedCharacter") -> Character:
    """Return the body of a rig as one that is moved by controllers."""
    return Character(body.leveled, float(body.stance.toe_height.mean()), body.leveled_map, body.source)


def read_drawn_character(text: str | None) -> "DrawnCharacter | None":
    """Read the character of a --character option, on which any motion can be put; None without the option.

    FileFormatError for files without one, RequestError where its joints cannot be identified.
    """
    if text is None:
        return None
    from scenes.drawn_character import DrawnCharacter

    character = DrawnCharacter.load(text)
    character.check_rig()
    return character
