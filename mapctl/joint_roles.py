"""Which joint of any rig is the hips, a toe, an upper leg, by the names that rigs commonly use."""

import re
from collections.abc import Sequence

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
_SUFFIXES = ("hips", "pelvis")  # after an unknown beginning
_ROOTS = ("rootjoint", "root")  # of rigs without hips


def find_hips(skeleton: Skeleton) -> int:
    """Find the index of the hips; RequestError lists the joints if none is named so."""
    names = [normalise_name(name) for name in skeleton.names]
    for wanted, fits in ((_HIPS, str.__eq__), (_SUFFIXES, str.endswith), (_ROOTS, str.__eq__)):
        for word in wanted:
            for joint, name in enumerate(names):
                if fits(name, word):
                    return joint
    raise _unknown_joint_error(skeleton, "hips")


def find_feet(skeleton: Skeleton) -> tuple[int, int]:
    """Find indices of the left and right toe, or foot where there are no toes; RequestError if there are none."""
    return _find_pair(skeleton, _TOES, "toe or foot")


def find_upper_legs(skeleton: Skeleton) -> tuple[int, int]:
    """Find indices of the left and right upper leg, whose line shows facing; RequestError if there are none."""
    return _find_pair(skeleton, _UPPER_LEGS, "upper leg")


def _find_pair(skeleton: Skeleton, parts: Sequence[str], role: str) -> tuple[int, int]:
    """Find the joints of a part by plain spellings, as leftfoot, footleft, lfoot, footl; then after an unknown
    beginning, as in `Character1_LeftFoot`, for which words as short as `lfoot` prove too little."""
    names = [normalise_name(name) for name in skeleton.names]
    for whole in (True, False):
        for part in parts:
            found: list[int] = []
            for side, han in (("left", "左"), ("right", "右")):
                words = [word for mark in (side, side[0], han) for word in (mark + part, part + mark)]
                ends = tuple(word for word in words if len(word) >= 6 and side in word)
                found += [j for j, name in enumerate(names) if (name in words if whole else name.endswith(ends))][:1]
            if len(found) == 2:
                return found[0], found[1]
    raise _unknown_joint_error(skeleton, f"left and right {role}")


def _unknown_joint_error(skeleton: Skeleton, role: str) -> RequestError:
    names = abbreviate_names(skeleton.names)
    return RequestError(f"cannot tell the {role} of this rig by name; its joints are {names}")


def classify_joints(skeleton: Skeleton) -> tuple[Role, ...]:
    """Classify the role of every joint, settled by what else the rig has.

    Where there are collars, a `shoulder` is the upper arm; without thighs, a hip with a side is one; without a head,
    the last of several neck joints is one.
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
    necks = [joint for joint, role in enumerate(found) if role == Role(Side.MIDDLE, Part.NECK)]
    if len(necks) > 1 and not skeleton.children(necks[-1]) and all(role.part is not Part.HEAD for role in found):
        found[necks[-1]] = Role(Side.MIDDLE, Part.HEAD)
    return tuple(found)
