"""Finding a joint of one side where the same joint of the other side is: as far down the tree, along bones as long."""

from collections.abc import Mapping

from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

_MAX_LENGTH_RATIO = 1.6  # of the lengths of two bones of one pair; performers are not the same on both sides


def find_by_other_side(skeleton: Skeleton, found: Mapping[str, int]) -> dict[str, int]:
    """Find canonical joints that only the other side has so far, from the hips outward."""
    more: dict[str, int] = {}
    for name in CANONICAL.names:
        known = {**found, **more}
        above = CANONICAL.names[CANONICAL.parents[CANONICAL.index(name)]] if name != "hips" else name
        needed = (mirror_name(name), above, mirror_name(above))
        if name in known or mirror_name(name) == name or not all(one in known for one in needed):
            continue
        path = _path(skeleton, known[mirror_name(above)], known[mirror_name(name)])
        ends = _follow(skeleton, known[above], path, {*known.values()}) if path else []
        below = [known[one] for one in _canonical_below(name) if one in known]
        fitting = [end for end in ends if all(_path(skeleton, end, joint) for joint in below)]
        if fitting:
            size = _count_below(skeleton, known[mirror_name(name)])
            more[name] = min(fitting, key=lambda end: abs(_count_below(skeleton, end) - size))
    return more


def _path(skeleton: Skeleton, above: int, joint: int) -> list[int]:
    """Return the joints below `above` on the way to a joint, and that joint; none where it does not hang from it."""
    path = []
    while joint >= 0 and joint != above:
        path.append(joint)
        joint = skeleton.parents[joint]
    return path[::-1] if joint == above else []


def _follow(skeleton: Skeleton, start: int, path: list[int], taken: set[int]) -> list[int]:
    """Return the joints below `start` to which bones lead that are as long as those of a path on the other side."""
    ends = [start]
    for joint in path:
        length = float(skeleton.offsets[joint].norm())
        ends = [child for end in ends for child in skeleton.children(end) if _are_alike(skeleton, child, length)]
    return [end for end in ends if end not in taken]


def _are_alike(skeleton: Skeleton, joint: int, length: float) -> bool:
    short, long = sorted((float(skeleton.offsets[joint].norm()), length))
    return long <= _MAX_LENGTH_RATIO * short + 1e-6


def _canonical_below(name: str) -> list[str]:
    """Return the canonical joints that hang from one."""
    below = [CANONICAL.index(name)]
    for joint in below:
        below += CANONICAL.children(joint)
    return [CANONICAL.names[joint] for joint in below[1:]]


def _count_below(skeleton: Skeleton, joint: int) -> int:
    return len(skeleton.children(joint)) + sum(_count_below(skeleton, child) for child in skeleton.children(joint))
