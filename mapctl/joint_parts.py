"""What a joint is, told from its name: side and body part, for any rig's way of naming."""

import re
from dataclasses import dataclass
from enum import Enum

from mapctl.skeleton import Skeleton


class Part(Enum):
    """A body part; a bone belongs to the part of the joint it starts at."""

    HIPS = "hips"
    TORSO = "torso"
    NECK = "neck"
    HEAD = "head"
    SHOULDER = "shoulder"
    UPPER_ARM = "upper arm"
    LOWER_ARM = "lower arm"
    HAND = "hand"
    FINGER = "finger"
    UPPER_LEG = "upper leg"
    LOWER_LEG = "lower leg"
    FOOT = "foot"
    TOES = "toes"
    OTHER = "other"


class Side(Enum):
    """Which half of the body."""

    LEFT = "left"
    RIGHT = "right"
    MIDDLE = "middle"


@dataclass(frozen=True)
class Role:
    """Side and part of one joint."""

    side: Side
    part: Part


# The first pattern that the lower-case name without its side holds decides, so the narrow ones stand first.
_PARTS = (
    (r"thumb|index|middle|mid\d|ring\d|ring$|pinky|little|finger", Part.FINGER),
    (r"toe", Part.TOES),
    (r"foot|ankle", Part.FOOT),
    (r"upper_?leg|up_?leg|thigh|femur", Part.UPPER_LEG),
    (r"lower_?leg|shin|calf|knee|tibia|leg", Part.LOWER_LEG),
    (r"fore_?arm|lower_?arm|low_?arm|elbow|radius", Part.LOWER_ARM),
    (r"hand|wrist|palm", Part.HAND),
    (r"collar|clavicle", Part.SHOULDER),
    (r"upper_?arm|up_?arm|shldr|humerus|arm", Part.UPPER_ARM),
    (r"shoulder", Part.SHOULDER),
    (r"neck", Part.NECK),
    (r"head|skull", Part.HEAD),
    (r"hip|pelvis|root|buttock", Part.HIPS),
    (r"spine|chest|abdomen|torso|back|waist|thorax|belly", Part.TORSO),
)
# Spelled out; alone between separators; before a capital (`lThigh`); before a Latin name (`lfemur`).
_SIDE = (
    r"{word}|{title}|{upper}|(?:^|[_.:\- ])[{letter}](?=[_.\- ]|$)|(?:^|:)[{letter}](?=[A-Z])"
    r"|^{small}(?=femur|tibia|foot|toes|humerus|radius|wrist|hand|fingers|thumb|clavicle|hipjoint)"
)
_SIDES = tuple(
    (
        side,
        re.compile(
            _SIDE.format(
                word=word, title=word.title(), upper=word.upper(), letter=word[0] + word[0].upper(), small=word[0]
            )
        ),
    )
    for side, word in ((Side.LEFT, "left"), (Side.RIGHT, "right"))
)


def role(name: str) -> Role:
    """Side and part of a joint by its name: `LeftUpLeg`, `lThigh`, `UpperLeg_L`, `mixamorig:LeftArm`."""
    for side, pattern in _SIDES:
        found = pattern.search(name)
        if found:
            return Role(side, _part(name[: found.start()] + name[found.end() :]))
    return Role(Side.MIDDLE, _part(name))


def roles(skeleton: Skeleton) -> tuple[Role, ...]:
    """The role of every joint, settled by what else the rig has.

    Where there are collars, a `shoulder` is the upper arm; without thighs, a hip with a side is one.
    """
    found = [role(name) for name in skeleton.names]
    collars = any(re.search("collar|clavicle", name, re.IGNORECASE) for name in skeleton.names)
    thighs = any(r.part is Part.UPPER_LEG for r in found)
    for joint, name in enumerate(skeleton.names):
        side, part = found[joint].side, found[joint].part
        if collars and part is Part.SHOULDER and "shoulder" in name.lower():
            found[joint] = Role(side, Part.UPPER_ARM)
        if not thighs and part is Part.HIPS and side is not Side.MIDDLE:
            found[joint] = Role(side, Part.UPPER_LEG)
    return tuple(found)


def _part(name: str) -> Part:
    for pattern, part in _PARTS:
        if re.search(pattern, name.lower()):
            return part
    return Part.OTHER
