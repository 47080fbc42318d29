"""Joint names: side and body part by a name, which joint a name stands for, and the nearest names."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from enum import Enum
from functools import lru_cache, partial

from mapctl.errors import RequestError

_MAX_SUGGESTIONS = 3  # names in a refusal


# Prefixes that name the program that wrote the rig, not the joint.
_PREFIX = re.compile(r"^(.*[:|]|mixamorig\d*[ _]*|bip\d+[ _]+|j_bip_(c_)?|(joint|def|org)[ _-]+)", re.IGNORECASE)


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
# Chinese and Japanese words stand beside the English ones; in Japanese 腕 is an arm and 足 a leg or a foot.
_PARTS = (
    (r"thumb|index|middle|mid\d|ring\d|ring$|pinky|little|finger|(?<![足脚])指", Part.FINGER),
    (r"toe|つま先|趾|足指|足先", Part.TOES),
    (r"foot|ankle|足首|足踝|脚踝", Part.FOOT),
    (r"upper_?leg|up_?leg|thigh|femur|大腿|太もも", Part.UPPER_LEG),
    (r"lower_?leg|shin|calf|knee|tibia|leg|小腿|膝|ひざ|すね", Part.LOWER_LEG),
    (r"足|脚", Part.FOOT),
    (r"fore_?arm|lower_?arm|low_?arm|elbow|radius|前臂|小臂|前腕|下腕|肘|ひじ", Part.LOWER_ARM),
    (r"hand|wrist|palm|手首|手腕|手", Part.HAND),
    (r"collar|clavicle|锁骨|鎖骨", Part.SHOULDER),
    (r"upper_?arm|up_?arm|shldr|humerus|arm|上臂|大臂|腕", Part.UPPER_ARM),
    (r"shoulder|肩", Part.SHOULDER),
    (r"neck|首|颈|頸|脖", Part.NECK),
    (r"head|skull|头|頭", Part.HEAD),
    (r"hip|pelvis|root|buttock|骨盆|盆骨|骨盤|臀|下半身", Part.HIPS),
    (r"spine|chest|abdomen|torso|back|waist|thorax|belly|脊|腰|胸|腹|上半身", Part.TORSO),
)


# Spelled out; alone between separators; before a capital (`lThigh`); before a Latin name (`lfemur`).
_SIDE = (
    r"{word}|{title}|{upper}|(?:^|[_.:\- ])[{letter}](?=[_.\- ]|$)|(?:^|:)[{letter}](?=[A-Z])"
    r"|[{han}]|^{small}(?=femur|tibia|foot|toes|humerus|radius|wrist|hand|fingers|thumb|clavicle|hipjoint)"
)


_SIDES = tuple(
    (
        side,
        re.compile(
            _SIDE.format(
                word=word,
                title=word.title(),
                upper=word.upper(),
                letter=word[0] + word[0].upper(),
                small=word[0],
                han=han,
            )
        ),
    )
    for side, word, han in ((Side.LEFT, "left", "左"), (Side.RIGHT, "right", "右"))
)


@lru_cache(maxsize=4096)
def normalise_name(name: str) -> str:
    """Normalise a name to lower case without program prefix and punctuation: `mixamorig:LeftToe` is `lefttoe`."""
    strip = partial(_PREFIX.sub, "")
    # Twice, for prefixes in a namespace; a name that is all prefix keeps itself.
    return re.sub(r"[\W_]", "", (strip(strip(name)) or name).lower())


def split_side(name: str) -> tuple[Side, str]:
    """Split a name into the side that it names and what is left of it: `LeftUpLeg` is left and `UpLeg`."""
    for side, pattern in _SIDES:
        found = pattern.search(name)
        if found:
            return side, name[: found.start()] + name[found.end() :]
    return Side.MIDDLE, name


def classify_joint(name: str) -> Role:
    """Classify a joint's side and part by its name: `LeftUpLeg`, `lThigh`, `UpperLeg_L`, `mixamorig:LeftArm`."""
    side, rest = split_side(name)
    return Role(side, next((part for pattern, part in _PARTS if re.search(pattern, rest.lower())), Part.OTHER))


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


def describe_nearest(wanted: str, names: Sequence[str], roles: Sequence[Role] | None = None) -> str:
    """Describe the few names nearest to a wanted one, the nearest first, for the end of a refusal.

    Those on the side and the limb that it names come first. `roles` are those of the names, else the names themselves
    show them.
    """
    role_of = dict(zip(names, map(classify_joint, names) if roles is None else roles, strict=True))
    asked, plain = classify_joint(wanted), normalise_name(wanted)
    limb = next((parts for parts in _LIMBS if asked.part in parts), set(Part))

    def distance(name: str) -> tuple[bool, bool, bool, float]:
        side, part = role_of[name].side, role_of[name].part
        likeness = SequenceMatcher(None, plain, normalise_name(name)).ratio()
        return asked.side not in (side, Side.MIDDLE), part not in limb, part is not asked.part, -likeness

    first, *others = sorted(names, key=distance)[:_MAX_SUGGESTIONS] or ["none"]
    return f"the nearest is {first}" + (f", then {' and '.join(others)}" if others else "")


def abbreviate_names(names: Sequence[str]) -> str:
    """List the first few of many names, and how many there are."""
    more = len(names) - 2 * _MAX_SUGGESTIONS
    return ", ".join(names[: 2 * _MAX_SUGGESTIONS]) + (f" and {more} more" if more > 0 else "")
