"""Which joint of any rig is the hips, a toe, an upper leg, by the names that rigs commonly use."""

import re
from collections.abc import Callable, Sequence

from mapctl.errors import RequestError
from mapctl.joint_names import Part, Role, Side, abbreviate_names, classify_joint, normalise_name
from mapctl.skeleton import Skeleton

# Without their side, best guess first: VRM, Bandai Namco, Mixamo, Daz, Biped, Unreal, ASF, SMPL.
# Where a rig has no toe joint, its foot stands for it.
_TOES = ("toes", "toebase", "toe", "toe0", "toejoint", "ball", "toeend", "つま先", "脚趾", "足指")
_TOES += ("foot", "footjoint", "ankle", "足首", "脚踝", "脚")
_UPPER_LEGS = ("upperleg", "upleg", "thigh", "thighbend", "femur", "legupper", "hip", "hipjoint")
_UPPER_LEGS += ("大腿", "太もも", "足")
_HIPS = ("hips", "hip", "pelvis", "骨盆", "盆骨", "骨盤", "下半身")
_ROOTS = ("rootjoint", "root")  # of rigs without hips


def find_hips(skeleton: Skeleton) -> int:
    """Find the index of the hips; RequestError lists the joints if none is named so."""
    names = _normalise_names(skeleton)
    for match, parts in ((_match_exactly, _HIPS), (_match_suffix, _HIPS), (_match_exactly, _ROOTS)):
        for part in parts:
            joint = match(names, {part})
            if joint is not None:
                return joint
    raise _unknown_joint_error(skeleton, "hips")


def find_feet(skeleton: Skeleton) -> tuple[int, int]:
    """Find indices of the left and right toe, or foot where there are no toes; RequestError if there are none."""
    return _find_pair(skeleton, _TOES, "toe or foot")


def find_upper_legs(skeleton: Skeleton) -> tuple[int, int]:
    """Find indices of the left and right upper leg, whose line tells facing; RequestError if there are none."""
    return _find_pair(skeleton, _UPPER_LEGS, "upper leg")


def _find_pair(skeleton: Skeleton, parts: Sequence[str], role: str) -> tuple[int, int]:
    names = _normalise_names(skeleton)
    for match in (_match_exactly, _match_suffix):
        for part in parts:
            left, right = match(names, _side_spellings(part, "left")), match(names, _side_spellings(part, "right"))
            if left is not None and right is not None:
                return left, right
    raise _unknown_joint_error(skeleton, f"left and right {role}")


def _side_spellings(part: str, side: str) -> set[str]:
    """Spell a part of one side in plain ways: leftfoot, footleft, lfoot, footl."""
    marks = (side, side[0], "左" if side == "left" else "右")
    return {f"{mark}{part}" for mark in marks} | {f"{part}{mark}" for mark in marks}


def _match_exactly(names: Sequence[str], wanted: set[str]) -> int | None:
    return _find_first(names, wanted.__contains__)


def _match_suffix(names: Sequence[str], wanted: set[str]) -> int | None:
    """Match a name after an unknown beginning (`Character1_LeftFoot`); words as short as `lfoot` prove too little."""
    telling = tuple(word for word in wanted if len(word) >= 6 and ("left" in word or "right" in word))
    return _find_first(names, lambda name: name.endswith(telling or tuple(wanted & {"hips", "pelvis"})))


def _find_first(names: Sequence[str], fits: Callable[[str], bool]) -> int | None:
    return next((joint for joint, name in enumerate(names) if fits(name)), None)


def _normalise_names(skeleton: Skeleton) -> list[str]:
    return [normalise_name(name) for name in skeleton.names]


def _unknown_joint_error(skeleton: Skeleton, role: str) -> RequestError:
    return RequestError(
        f"cannot tell the {role} of this rig by name; its joints are {abbreviate_names(skeleton.names)}"
    )


def classify_joints(skeleton: Skeleton) -> tuple[Role, ...]:
    """Classify the role of every joint, settled by what else the rig has.

    Where there are collars, a `shoulder` is the upper arm; without thighs, a hip with a side is one.
    """
    found = [classify_joint(name) for name in skeleton.names]
    collars = any(re.search("collar|clavicle", name, re.IGNORECASE) for name in skeleton.names)
    thighs = any(r.part is Part.UPPER_LEG for r in found)
    for joint, name in enumerate(skeleton.names):
        side, part = found[joint].side, found[joint].part
        if collars and part is Part.SHOULDER and "shoulder" in name.lower():
            found[joint] = Role(side, Part.UPPER_ARM)
        if not thighs and part is Part.HIPS and side is not Side.MIDDLE:
            found[joint] = Role(side, Part.UPPER_LEG)
    return tuple(found)
