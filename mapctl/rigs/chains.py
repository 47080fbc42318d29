"""Which joint is which by the tree alone: legs and a trunk hang from the hips, arms and a head from the trunk."""

from collections.abc import Mapping

import torch

from mapctl.skeleton import Skeleton

_ALIKE = 1.2  # ratio of the reaches of two limbs of one pair
_SHARE = 0.35  # of the body's reach, below which a branch is no limb


def find(skeleton: Skeleton) -> Mapping[str, int]:
    """Canonical joint name to the rig's joint, as far as the tree tells; empty where it is no human body's.

    Which limb of a pair is the left one is not told: sides are to be checked by what else is known.
    """
    tree = _Tree(skeleton)
    for hips in range(skeleton.num_joints):
        for legs in tree.pairs(hips):
            others = [child for child in tree.children[hips] if child not in legs]
            for trunk in sorted(others, key=lambda child: -tree.reach[child]):
                for chest in tree.below(trunk):
                    arms = tree.pairs(chest)
                    if arms:
                        return _body(tree, hips, legs, chest, arms[0])
    return {}


def _body(tree: "_Tree", hips: int, legs: tuple[int, int], chest: int, arms: tuple[int, int]) -> Mapping[str, int]:
    found = {"hips": hips}
    for side, leg, arm in zip(("left", "right"), legs, arms, strict=True):
        found |= tree.limb(leg, [side + part for part in ("", "UpperLeg", "LowerLeg", "Foot", "Toes")])
        found |= tree.limb(arm, [side + part for part in ("Shoulder", "UpperArm", "LowerArm", "Hand", "")])
    trunk = tree.way(hips, chest)
    if trunk:
        found["spine"] = trunk[0]
    if len(trunk) > 1:
        found["chest"] = trunk[-1]
    others = [child for child in tree.children[chest] if child not in arms]
    if others:
        up = tree.chain(max(others, key=lambda child: tree.reach[child]))
        found |= {"head": up[0]} if len(up) == 1 else {"neck": up[0], "head": up[1]}
    return found


class _Tree:
    """Bone lengths and reaches."""

    def __init__(self, skeleton: Skeleton):
        self.parents = skeleton.parents
        self.children = [skeleton.children(joint) for joint in range(skeleton.num_joints)]
        self.length = skeleton.offsets.norm(dim=-1).tolist()
        ends = {skeleton.index(name): torch.tensor(site).norm().item() for name, site in skeleton.end_offsets.items()}
        self.reach = [0.0] * skeleton.num_joints
        for joint in reversed(range(skeleton.num_joints)):
            below = [self.length[child] + self.reach[child] for child in self.children[joint]]
            self.reach[joint] = max([ends.get(joint, 0.0), *below])

    def pairs(self, joint: int) -> list[tuple[int, int]]:
        """Children that are two limbs of one pair: of at least two bones, and of about the same length."""
        least = _SHARE * max(self.reach)
        limbs = [c for c in self.children[joint] if self.reach[c] >= least and len(self.chain(c)) >= 3]
        alike = []
        for k, first in enumerate(limbs):
            for second in limbs[k + 1 :]:
                far = sorted((self.reach[first], self.reach[second]))
                if far[1] <= _ALIKE * far[0]:
                    alike.append((far[1] / far[0], (first, second)))
        return [pair for _, pair in sorted(alike)]

    def chain(self, joint: int) -> list[int]:
        """The joints from this one to the farthest leaf."""
        way = [joint]
        while self.children[way[-1]]:
            way.append(max(self.children[way[-1]], key=lambda child: self.length[child] + self.reach[child]))
        return way

    def below(self, joint: int) -> list[int]:
        """The joint and all below it, parents first."""
        found = [joint]
        for above in found:
            found.extend(self.children[above])
        return found

    def way(self, above: int, joint: int) -> list[int]:
        """The joints below `above` on the way to a joint, and that joint."""
        way = []
        while joint != above:
            way.append(joint)
            joint = self.parents[joint]
        return way[::-1]

    def limb(self, joint: int, names: list[str]) -> dict[str, int]:
        """Names of a limb's joints, the second and third of which begin its two longest bones; '' names none."""
        way = self.chain(joint)
        both = [self.length[way[k + 1]] + self.length[way[k + 2]] for k in range(len(way) - 2)]
        upper = max(range(len(both)), key=both.__getitem__)
        placed = {name: upper + k - 1 for k, name in enumerate(names)}
        return {name: way[at] for name, at in placed.items() if len(name) > 5 and 0 <= at < len(way)}
