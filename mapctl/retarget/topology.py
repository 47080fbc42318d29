"""Which joint is which by the tree: legs and a trunk hang from the hips, arms and a head from the trunk."""

from collections.abc import Collection, Mapping
from itertools import product

import torch

from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

_MAX_LENGTH_RATIO = 1.2  # ratio of the lengths of two bones of one pair
_MIN_REACH_SHARE = 0.25  # of the reach of the joint that they hang from, below which two branches are no limbs
_MAX_SIDE_RATIO = 1.6  # of the lengths of two bones of one pair; performers are not the same on both sides

LimbPair = tuple[list[int], list[int]]
"""The joints of the two limbs of a pair, side by side, from the body outward."""


def match_by_tree(skeleton: Skeleton) -> Mapping[str, int]:
    """Match canonical joint names to the rig's joints, as far as the tree shows; empty where it is no human body's.

    Sides are arbitrary: which limb of a pair is the left one has to be decided by names or positions.
    """
    tree = JointTree(skeleton)
    for hips in range(skeleton.num_joints):
        for legs in tree.find_limb_pairs(hips):
            others = [child for child in tree.children[hips] if child not in (legs[0][0], legs[1][0])]
            for trunk in sorted(others, key=lambda child: -tree.reach[child]):
                for chest in tree.below(trunk):
                    arms = tree.find_limb_pairs(chest)
                    if arms:
                        return _name_body_joints(tree, hips, legs, chest, arms[0])
    return {}


def _name_body_joints(tree: "JointTree", hips: int, legs: LimbPair, chest: int, arms: LimbPair) -> Mapping[str, int]:
    found = {"hips": hips}
    for side, leg, arm in zip(("left", "right"), legs, arms, strict=True):
        found |= tree.limb(leg, [side + part for part in ("", "UpperLeg", "LowerLeg", "Foot", "Toes")])
        found |= tree.limb(arm, [side + part for part in ("Shoulder", "UpperArm", "LowerArm", "Hand", "")])
    trunk = path_below(tree.skeleton, hips, chest)
    if trunk:
        found["spine"] = trunk[0]
    if len(trunk) > 1:
        found["chest"] = trunk[-1]
    others = [child for child in tree.children[chest] if child not in (arms[0][0], arms[1][0])]
    if others:
        up = tree.chain(max(others, key=lambda child: tree.reach[child]))
        found |= {"head": up[0]} if len(up) == 1 else {"neck": up[0], "head": up[1]}
    return found


class JointTree:
    """Children, bone lengths and reaches of a skeleton's joints; a reach is the length of the longest chain below."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self.children = [skeleton.children(joint) for joint in range(skeleton.num_joints)]
        self.length = skeleton.offsets.norm(dim=-1).tolist()
        ends = {skeleton.index(name): torch.tensor(site).norm().item() for name, site in skeleton.end_offsets.items()}
        self.reach = [0.0] * skeleton.num_joints
        for joint in reversed(range(skeleton.num_joints)):
            below = [self.length[child] + self.reach[child] for child in self.children[joint]]
            self.reach[joint] = max([ends.get(joint, 0.0), *below])

    def find_limb_pairs(self, joint: int) -> list[LimbPair]:
        """Find branches that are a pair of limbs, bone for bone of about the same length; the longest pair first."""
        found = []
        for k, first in enumerate(self.children[joint]):
            for second in self.children[joint][k + 1 :]:
                paths = self.trace_limb_pair(first, second)
                long = sum(self.length[joint] for joint in paths[0][1:])
                far = long >= _MIN_REACH_SHARE * self.reach[joint]
                if far and len(paths[0]) >= 3 and self.are_alike(first, second):
                    found.append((-long, paths))
        return [paths for _, paths in sorted(found)]

    def trace_limb_pair(self, first: int, second: int) -> LimbPair:
        """Follow two branches down as long as they are alike; a sword in one hand is not."""
        paths = [first], [second]
        while True:
            ends = product(self.children[paths[0][-1]], self.children[paths[1][-1]])
            steps = [step for step in ends if self.are_alike(*step)]
            if not steps:
                return paths
            best = max(steps, key=lambda step: min(self.reach[joint] + self.length[joint] for joint in step))
            for path, joint in zip(paths, best, strict=True):
                path.append(joint)

    def are_alike(self, first: int, second: int) -> bool:
        """Return whether two bones are of about the same length."""
        return are_alike(self.length[first], self.length[second], _MAX_LENGTH_RATIO)

    def chain(self, joint: int) -> list[int]:
        """Return the joints from this one to the farthest leaf."""
        path = [joint]
        while self.children[path[-1]]:
            path.append(max(self.children[path[-1]], key=lambda child: self.length[child] + self.reach[child]))
        return path

    def below(self, joint: int) -> list[int]:
        """Return the joint and all below it, parents first."""
        found = [joint]
        for above in found:
            found.extend(self.children[above])
        return found

    def limb(self, path: list[int], names: list[str]) -> dict[str, int]:
        """Name a limb's joints: the second and third begin its two longest bones; a bare side is no name."""
        both = [self.length[path[k + 1]] + self.length[path[k + 2]] for k in range(len(path) - 2)]
        upper = max(range(len(both)), key=both.__getitem__)
        placed = {name: upper + k - 1 for k, name in enumerate(names)}
        return {name: path[at] for name, at in placed.items() if len(name) > 5 and 0 <= at < len(path)}


def are_alike(first: float, second: float, ratio: float) -> bool:
    """Return whether two lengths, metres, differ by no more than a ratio."""
    short, long = sorted((first, second))
    return long <= ratio * short + 1e-6


def find_by_other_side(skeleton: Skeleton, found: Mapping[str, int]) -> dict[str, int]:
    """Find canonical joints that only the other side has so far, from the hips outward."""
    more: dict[str, int] = {}
    for name in CANONICAL.names:
        known = {**found, **more}
        above = CANONICAL.names[CANONICAL.parents[CANONICAL.index(name)]] if name != "hips" else name
        needed = (mirror_name(name), above, mirror_name(above))
        if name in known or mirror_name(name) == name or not all(one in known for one in needed):
            continue
        path = path_below(skeleton, known[mirror_name(above)], known[mirror_name(name)])
        ends = _follow(skeleton, known[above], path, {*known.values()}) if path else []
        parts = {CANONICAL.names[joint] for joint in descendants(CANONICAL, {CANONICAL.index(name)})}
        below = [known[part] for part in parts & known.keys()]
        fitting = [end for end in ends if all(path_below(skeleton, end, joint) for joint in below)]
        if fitting:
            size = len(descendants(skeleton, {known[mirror_name(name)]}))
            more[name] = min(fitting, key=lambda end: abs(len(descendants(skeleton, {end})) - size))
    return more


def _follow(skeleton: Skeleton, start: int, path: list[int], taken: set[int]) -> list[int]:
    """Return the joints below `start` to which bones lead that are as long as those of a path on the other side."""
    ends, lengths = [start], skeleton.offsets.norm(dim=-1).tolist()
    for joint in path:
        below = [child for end in ends for child in skeleton.children(end)]
        ends = [child for child in below if are_alike(lengths[joint], lengths[child], _MAX_SIDE_RATIO)]
    return [end for end in ends if end not in taken]


def descendants(skeleton: Skeleton, joints: Collection[int]) -> set[int]:
    """Return joints and all below them."""
    found = set(joints)
    for child, parent in enumerate(skeleton.parents):
        if parent in found:
            found.add(child)
    return found


def ancestors(skeleton: Skeleton, joints: Collection[int]) -> set[int]:
    """Return joints and all above them."""
    found = set(joints)
    for child in reversed(range(1, skeleton.num_joints)):
        if child in found:
            found.add(skeleton.parents[child])
    return found


def path_below(skeleton: Skeleton, above: int, joint: int) -> list[int]:
    """Return the joints below `above` down to a joint, and that joint; none where it does not hang from it."""
    path = []
    while joint >= 0 and joint != above:
        path.append(joint)
        joint = skeleton.parents[joint]
    return path[::-1] if joint == above else []
