"""Joints as people name them: by the rig's own or canonical names, in any case; and what may be meant."""

from collections.abc import Callable, Mapping, Sequence
from difflib import SequenceMatcher
from typing import TYPE_CHECKING

from mapctl.errors import RequestError
from mapctl.joint_parts import Part, Role, Side, role
from mapctl.joint_roles import plain_name

if TYPE_CHECKING:
    from mapctl.motion import Motion
    from mapctl.retarget.rigs import Rig

_FEW = 3  # names in a refusal
_LIMBS = (
    {Part.SHOULDER, Part.UPPER_ARM, Part.LOWER_ARM, Part.HAND, Part.FINGER},
    {Part.UPPER_LEG, Part.LOWER_LEG, Part.FOOT, Part.TOES},
    {Part.HIPS, Part.TORSO, Part.NECK, Part.HEAD},
)


def find_joint(wanted: str, names: Sequence[str], canonical: Callable[[], Mapping[str, int]] = dict) -> int | None:
    """The joint of a rig that a name stands for; None for none.

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
    for spelled in (str.lower, plain_name):
        alike = [joint for joint, name in enumerate(names) if spelled(name) == spelled(wanted)]
        if len(alike) > 1:
            several = " and ".join(names[joint] for joint in alike[:_FEW])
            raise RequestError(f"{wanted!r} may be {several}; write it as the rig does")
        if alike:
            return alike[0]
        if wanted.lower() in lower:
            return lower[wanted.lower()]
    return None


def canonical_joints(motion: "Motion", rig: "Rig | None" = None) -> dict[str, int]:
    """The joint of a motion's rig by canonical name, those that it has; none where the rig cannot be told."""
    from mapctl.retarget import map_rig
    from mapctl.skeleton import CANONICAL

    try:
        joint_of = map_rig(motion.skeleton, rig, motion=motion).joint_of
    except RequestError:
        return {}
    return {name: joint for name, joint in zip(CANONICAL.names, joint_of, strict=True) if joint is not None}


def suggest(wanted: str, names: Sequence[str], roles: Sequence[Role] | None = None) -> list[str]:
    """The few names nearest to a wanted one, the nearest first.

    They stay on the side and the limb that it tells, if any name is there. `roles` tell what the names are, else the
    names themselves do.
    """
    told = dict(zip(names, map(role, names) if roles is None else roles, strict=True))
    asked, plain = role(wanted), plain_name(wanted)

    def kept(fits: Callable[[Role], bool], some: Sequence[str]) -> Sequence[str]:
        return [name for name in some if fits(told[name])] or some

    if asked.side is not Side.MIDDLE:
        names = kept(lambda r: r.side is asked.side, names)
    for limb in _LIMBS:
        if asked.part in limb:
            names = kept(lambda r, limb=limb: r.part in limb, names)
    likeness = {name: SequenceMatcher(None, plain, plain_name(name)).ratio() for name in names}
    return sorted(names, key=lambda name: (told[name].part is not asked.part, -likeness[name]))[:_FEW]


def nearest(wanted: str, names: Sequence[str], roles: Sequence[Role] | None = None) -> str:
    """The end of a refusal: which names are nearest."""
    first, *others = [*suggest(wanted, names, roles)] or ["none"]
    return f"the nearest is {first}" + (f", then {' and '.join(others)}" if others else "")


def shorten(names: Sequence[str]) -> str:
    """The first few of many names, and how many there are."""
    more = len(names) - 2 * _FEW
    return ", ".join(names[: 2 * _FEW]) + (f" and {more} more" if more > 0 else "")
