"""Joint names: side and body part by a name, which joint a name stands for, and the nearest names."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from enum import Enum
from functools import lru_cache, partial

from mapctl.errors import RequestError

_MAX_SUGGESTIONS = 3  # names in a refusal


# Beginnings that say which program made the rig rather than what the joint is.
_PREFIX = re.compile(r"^(.*[:|]|mixamorig\d*[ _]*|bip\d+[ _]+|j_bip_(c_)?|(joint|def)[ _-]+)", re.IGNORECASE)


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


_LIMBS = (
    {Part.SHOULDER, Part.UPPER_ARM, Part.LOWER_ARM, Part.HAND, Part.FINGER},
    {Part.UPPER_LEG, Part.LOWER_LEG, Part.FOOT, Part.TOES},
    {Part.HIPS, Part.TORSO, Part.NECK, Part.HEAD},
)


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


@lru_cache(maxsize=4096)
def normalise_name(name: str) -> str:
    """Normalise a name to lower case without program prefix and punctuation: `mixamorig:LeftToe` is `lefttoe`."""
    strip = partial(_PREFIX.sub, "")
    # Twice, for prefixes in a namespace; a name that is all prefix keeps itself.
    return re.sub(r"[^a-z0-9]", "", (strip(strip(name)) or name).lower())


def classify_joint(name: str) -> Role:
    """Classify a joint's side and part by its name: `LeftUpLeg`, `lThigh`, `UpperLeg_L`, `mixamorig:LeftArm`."""
    for side, pattern in _SIDES:
        found = pattern.search(name)
        if found:
            return Role(side, _classify_part(name[: found.start()] + name[found.end() :]))
    return Role(Side.MIDDLE, _classify_part(name))


def _classify_part(name: str) -> Part:
    for pattern, part in _PARTS:
        if re.search(pattern, name.lower()):
            return part
    return Part.OTHER


def find_joint(wanted: str, names: Sequence[str], canonical: Callable[[], Mapping[str, int]] = dict) -> int | None:
    """Find the joint of a rig that a name stands for; None for none.

    In this order: the rig's own `names` as they are written, canonical names, both in any case, and own names without
    prefix and punctuation. `canonical` gives the rig's joint by canonical name, and is asked only where it is needed.
    RequestError for a name that two joints have but for case.
    """
    if wanted in names:
        return names.index(wanted)
    known = canonical()
    if wanted in known:
        return known[wanted]
    lower = {name.lower(): joint for name, joint in known.items()}
    for spelled in (str.lower, normalise_name):
        alike = [joint for joint, name in enumerate(names) if spelled(name) == spelled(wanted)]
        if len(alike) > 1:
            several = " and ".join(names[joint] for joint in alike[:_MAX_SUGGESTIONS])
            raise RequestError(f"{wanted!r} may be {several}; write it as the rig does")
        if alike:
            return alike[0]
        if wanted.lower() in lower:
            return lower[wanted.lower()]
    return None


def suggest_joints(wanted: str, names: Sequence[str], roles: Sequence[Role] | None = None) -> list[str]:
    """Return the few names nearest to a wanted one, the nearest first.

    They stay on the side and the limb that it tells, if any name is there. `roles` tell what the names are, else the
    names themselves do.
    """
    told = dict(zip(names, map(classify_joint, names) if roles is None else roles, strict=True))
    asked, plain = classify_joint(wanted), normalise_name(wanted)

    def kept(fits: Callable[[Role], bool], some: Sequence[str]) -> Sequence[str]:
        return [name for name in some if fits(told[name])] or some

    if asked.side is not Side.MIDDLE:
        names = kept(lambda r: r.side is asked.side, names)
    for limb in _LIMBS:
        if asked.part in limb:
            names = kept(lambda r, limb=limb: r.part in limb, names)
    likeness = {name: SequenceMatcher(None, plain, normalise_name(name)).ratio() for name in names}
    return sorted(names, key=lambda name: (told[name].part is not asked.part, -likeness[name]))[:_MAX_SUGGESTIONS]


def describe_nearest(wanted: str, names: Sequence[str], roles: Sequence[Role] | None = None) -> str:
    """Describe the nearest names, for the end of a refusal."""
    first, *others = [*suggest_joints(wanted, names, roles)] or ["none"]
    return f"the nearest is {first}" + (f", then {' and '.join(others)}" if others else "")


def abbreviate_names(names: Sequence[str]) -> str:
    """List the first few of many names, and how many there are."""
    more = len(names) - 2 * _MAX_SUGGESTIONS
    return ", ".join(names[: 2 * _MAX_SUGGESTIONS]) + (f" and {more} more" if more > 0 else "")
