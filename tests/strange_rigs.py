"""Rigs that invite mistakes: other scripts, prefixes, names in disorder, animals, two bodies."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import torch
from rig_maker import Make, make, names_of, person

from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton

SURE, DOUBTFUL, REFUSED = "sure", "doubtful", "refused"
NONSENSE = {name: f"bone_{number}" for number, name in enumerate(CANONICAL.names)}
_SHORT = ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes")


def both_sides(middle: Sequence[str], limbs: str) -> dict[str, str]:
    """Names by canonical joint, from those of the trunk and those of the left limbs with the mark of the side."""
    names = dict(zip(("hips", "spine", "chest", "neck", "head"), middle, strict=True))
    for side, mark in (("left", "左"), ("right", "右")):
        names |= {side + part: word.replace("左", mark) for part, word in zip(_SHORT, limbs.split(), strict=True)}
    return names


CHINESE = both_sides(["骨盆", "腰", "胸", "脖子", "头"], "左肩 左上臂 左前臂 左手 左大腿 左小腿 左脚 左脚趾")
JAPANESE = both_sides(["骨盤", "腹", "胸", "首", "頭"], "左鎖骨 左上腕 左前腕 左手 左太もも 左すね 左足首 左足指")


@dataclass(frozen=True, eq=False)
class Strange:
    """A motion on a strange rig, what may be said of it, and which joints it has in truth."""

    motion: Motion
    allowed: tuple[str, ...]
    truth: Mapping[str, str] | None = None
    reason: str = ""
    rig: str | None = None


def rigged(names: Mapping[str, str], **options) -> tuple[Motion, Mapping[str, str]]:
    """A walk on a rig, and its joints."""
    result = make(Make(names, **options))
    return result.motion(person(options.get("size", 1.0), 30)), result.joint


def renamed(motion: Motion, name: Callable[[str], str]) -> Motion:
    """The motion with other names."""
    old = motion.skeleton
    ends = {name(joint): end for joint, end in old.end_offsets.items()}
    return replace(motion, skeleton=Skeleton(tuple(map(name, old.names)), old.parents, old.offsets, ends))


def stretched(motion: Motion, **lengths: float) -> Motion:
    """The motion with some bones longer, by the name of the joint that they lead to."""
    offsets = motion.skeleton.offsets.clone()
    for name, factor in lengths.items():
        offsets[motion.skeleton.names.index(name)] *= factor
    return replace(motion, skeleton=replace(motion.skeleton, offsets=offsets))


def pair(first: Motion, second: Motion, apart: float = 2.0) -> Motion:
    """Two bodies below one joint, side by side."""
    names, parents, offsets = ["Scene"], [-1], [torch.zeros(3, dtype=torch.float64)]
    turns = [torch.tensor([0.0, 0, 0, 1]).double().expand(first.num_frames, 1, 4)]
    for motion, x in ((first, 0.0), (second, apart)):
        start = len(names)
        names += motion.skeleton.names
        parents += [0 if p < 0 else p + start for p in motion.skeleton.parents]
        offsets += [torch.tensor([x, 0.9, 0.0]).double(), *motion.skeleton.offsets[1:]]
        turns.append(motion.local_quat_xyzw)
    skeleton = Skeleton(tuple(names), tuple(parents), torch.stack(offsets))
    return Motion(skeleton, first.fps, torch.zeros(first.num_frames, 3).double(), torch.cat(turns, dim=1))


def standing(joints: Sequence[tuple[str, str, tuple[float, float, float]]], frames: int = 12) -> Motion:
    """A skeleton that stands still, its first joint the root."""
    names = [name for name, _, _ in joints]
    parents = tuple(names.index(above) if above else -1 for _, above, _ in joints)
    offsets = torch.tensor([offset for *_, offset in joints], dtype=torch.float64)
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(frames, len(names), 4)
    root = torch.zeros(frames, 3, dtype=torch.float64)
    return Motion(Skeleton(tuple(names), parents, offsets), Fraction(30), root, still.clone())


def animal(names: Mapping[str, str], *, tail: bool = True) -> Motion:
    """A dog that stands: trunk level along +Z, four legs down."""
    joints = [(names["hips"], "", (0.0, 0.0, 0.0))]
    joints += [(names["spine"], names["hips"], (0.0, 0.02, 0.2)), (names["chest"], names["spine"], (0.0, 0.0, 0.3))]
    joints += [(names["neck"], names["chest"], (0.0, 0.1, 0.2)), (names["head"], names["neck"], (0.0, 0.1, 0.1))]
    for side, x in (("left", 0.1), ("right", -0.1)):
        joints.append((names[side + "Shoulder"], names["chest"], (x, 0.0, 0.05)))
        joints.append((names[side + "UpperArm"], names[side + "Shoulder"], (0.0, -0.1, 0.0)))
        joints.append((names[side + "LowerArm"], names[side + "UpperArm"], (0.0, -0.2, -0.03)))
        joints.append((names[side + "Hand"], names[side + "LowerArm"], (0.0, -0.2, 0.0)))
        joints.append((names[side + "UpperLeg"], names["hips"], (x, -0.05, 0.0)))
        joints.append((names[side + "LowerLeg"], names[side + "UpperLeg"], (0.0, -0.22, 0.05)))
        joints.append((names[side + "Foot"], names[side + "LowerLeg"], (0.0, -0.22, -0.08)))
        joints.append((names[side + "Toes"], names[side + "Foot"], (0.0, -0.05, 0.08)))
    if tail:
        joints += [("Tail", names["hips"], (0.0, 0.0, -0.2)), ("Tail1", "Tail", (0.0, 0.0, -0.2))]
    return standing(joints)


def swap(names: Mapping[str, str], *pairs: tuple[str, str]) -> dict[str, str]:
    """The names with some of them exchanged."""
    found = dict(names)
    for a, b in pairs:
        found[a], found[b] = found[b], found[a]
    return found


def _cases() -> dict[str, Strange]:
    mixamo = names_of("mixamo")
    walk, truth = rigged(mixamo, arms_down_deg=30)
    plain = {c: own.removeprefix("mixamorig:") for c, own in mixamo.items()}
    bare = renamed(walk, lambda name: name.removeprefix("mixamorig:"))
    smpl, smpl_truth = rigged(names_of("smpl"))
    found = {
        "Mixamo": Strange(walk, (SURE,), truth, rig="mixamo"),
        "Chinese": Strange(*_told(rigged(CHINESE), SURE)),
        "Japanese": Strange(*_told(rigged(JAPANESE, arms_down_deg=40), SURE)),
        "no words": Strange(*_told(rigged(NONSENSE), DOUBTFUL), reason="21 joints are known by their positions alone"),
        "mirrored": Strange(*_told(rigged(mixamo, swapped=True), DOUBTFUL), reason="called left are on the right"),
        "no neck": Strange(*_told(rigged({c: o for c, o in mixamo.items() if c != "neck"}), SURE)),
        "one hand missing": Strange(
            *_told(rigged({c: o for c, o in mixamo.items() if c != "leftHand"}, extras=False), DOUBTFUL),
            reason="leftHand is missing",
        ),
        "one name lost": Strange(
            *_told(rigged(mixamo | {"leftHand": "a17"}), DOUBTFUL),
            reason="leftHand is known by its position alone (joint 'a17')",
        ),
        "no head": Strange(
            *_told(rigged({c: o for c, o in mixamo.items() if c not in ("head", "neck")}), DOUBTFUL),
            reason="no joint is known for head",
        ),
        "too large": Strange(*_told(rigged(mixamo, size=3.0), DOUBTFUL), reason="the unit may be wrong"),
        "one long shin": Strange(
            stretched(walk, **{"mixamorig:LeftFoot": 1.6}), (DOUBTFUL,), truth, reason="leftFoot and rightFoot differ"
        ),
        "arms to the floor": Strange(
            stretched(walk, **{f"mixamorig:{s}{p}": 2.6 for s in ("Left", "Right") for p in ("ForeArm", "Hand")}),
            (DOUBTFUL,),
            truth,
            reason="2.6 times as long as a person's",
        ),
        "both thighs on one side": Strange(
            stretched(walk, **{"mixamorig:LeftUpLeg": -1.0}), (DOUBTFUL,), reason="on the wrong side of the hips"
        ),
        "a dog with a person's names": Strange(animal(plain), (DOUBTFUL, REFUSED)),
        "a dog with paws": Strange(
            renamed(animal(plain, tail=False), lambda name: name.replace("Hand", "Paw").replace("Foot", "HindPaw")),
            (DOUBTFUL, REFUSED),
        ),
        "two people by name": Strange(
            pair(renamed(bare, "char1:{}".format), renamed(bare, "char2:{}".format)),
            (DOUBTFUL, REFUSED),
            reason="another body is in the file",
        ),
        "arms called the other way": Strange(
            rigged(swap(mixamo, *((f"left{p}", f"right{p}") for p in _SHORT[:4])))[0],
            (DOUBTFUL, REFUSED),
            reason="the left arm is on the side of the right leg",
        ),
        "a snake": Strange(
            standing([(f"v{n}", f"v{n - 1}" if n else "", (0.0, 0.0, 0.1)) for n in range(30)]), (REFUSED,)
        ),
    }
    for label, name, rig, base, joints in (
        ("char1:Hips", "char1:{}", "mixamo", bare, plain),
        ("Armature|mixamorig:Hips", "Armature|{}", "mixamo", walk, truth),
        ("m_avg_Pelvis", "m_avg_{}", "smpl", smpl, smpl_truth),
    ):
        own = {c: name.format(joint) for c, joint in joints.items()}
        found[f"prefix of {label}"] = Strange(renamed(base, name.format), (SURE,), own, rig=rig)
    return found


def _told(rig: tuple[Motion, Mapping[str, str]], *allowed: str) -> tuple[Motion, tuple[str, ...], Mapping[str, str]]:
    return rig[0], allowed, rig[1]


CASES = _cases()
"""Strange rigs by what is strange about them."""
