"""Which joint of any rig is the hips, a toe, an upper leg: told by the names that rigs commonly use."""

import re
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

from mapctl.errors import RequestError
from mapctl.skeleton import Skeleton

# Without their side, best guess first: VRM, Bandai Namco, Mixamo, Daz, Biped, Unreal, ASF, SMPL.
# Where a rig has no toe joint, its foot stands for it.
_TOES = ("toes", "toebase", "toe", "toe0", "toejoint", "ball", "toeend", "foot", "footjoint", "ankle")
_UPPER_LEGS = ("upperleg", "upleg", "thigh", "thighbend", "femur", "legupper", "hip", "hipjoint")
_HIPS = ("hips", "hip", "pelvis")
_ROOTS = ("rootjoint", "root")  # of rigs without hips

# Beginnings that say which program made the rig rather than what the joint is.
_PREFIX = re.compile(r"^(.*[:|]|mixamorig\d*[ _]*|bip\d+[ _]+|j_bip_(c_)?|(joint|def)[ _-]+)", re.IGNORECASE)


def find_hips(skeleton: Skeleton) -> int:
    """Index of the hips; RequestError lists the joints if none is named so."""
    names = _plain_names(skeleton)
    for match, parts in ((_exactly, _HIPS), (_at_the_end, _HIPS), (_exactly, _ROOTS)):
        for part in parts:
            joint = match(names, {part})
            if joint is not None:
                return joint
    raise _missing(skeleton, "hips")


def find_feet(skeleton: Skeleton) -> tuple[int, int]:
    """Indices of the left and right toe, or foot where there are no toes; RequestError if there are none."""
    return _find_pair(skeleton, _TOES, "toe or foot")


def find_upper_legs(skeleton: Skeleton) -> tuple[int, int]:
    """Indices of the left and right upper leg, whose line tells facing; RequestError if there are none."""
    return _find_pair(skeleton, _UPPER_LEGS, "upper leg")


@lru_cache(maxsize=4096)
def plain_name(name: str) -> str:
    """Lower case without program prefix and punctuation: `mixamorig:LeftToeBase` is `lefttoebase`."""
    strip = partial(_PREFIX.sub, "")
    # Twice, for prefixes in a namespace; a name that is all prefix keeps itself.
    return re.sub(r"[^a-z0-9]", "", (strip(strip(name)) or name).lower())


def _find_pair(skeleton: Skeleton, parts: Sequence[str], role: str) -> tuple[int, int]:
    names = _plain_names(skeleton)
    for match in (_exactly, _at_the_end):
        for part in parts:
            left, right = match(names, _sided(part, "left")), match(names, _sided(part, "right"))
            if left is not None and right is not None:
                return left, right
    raise _missing(skeleton, f"left and right {role}")


def _sided(part: str, side: str) -> set[str]:
    """Plain ways to write a part of one side: leftfoot, footleft, lfoot, footl."""
    return {f"{mark}{part}" for mark in (side, side[0])} | {f"{part}{mark}" for mark in (side, side[0])}


def _exactly(names: Sequence[str], wanted: set[str]) -> int | None:
    return _first(names, wanted.__contains__)


def _at_the_end(names: Sequence[str], wanted: set[str]) -> int | None:
    """After an unknown beginning (`Character1_LeftFoot`); words as short as `lfoot` prove too little."""
    telling = tuple(word for word in wanted if len(word) >= 6 and ("left" in word or "right" in word))
    return _first(names, lambda name: name.endswith(telling or tuple(wanted & {"hips", "pelvis"})))


def _first(names: Sequence[str], fits: Callable[[str], bool]) -> int | None:
    return next((joint for joint, name in enumerate(names) if fits(name)), None)


def _plain_names(skeleton: Skeleton) -> list[str]:
    return [plain_name(name) for name in skeleton.names]


def _missing(skeleton: Skeleton, role: str) -> RequestError:
    from mapctl.joint_names import shorten  # late: it knows rigs' names by this module

    return RequestError(f"cannot tell the {role} of this rig by name; its joints are {shorten(skeleton.names)}")
