"""Whether the bones of an understood rig are those of a person: lengths, both sides alike, order of the trunk, size."""

from collections.abc import Iterator
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.retarget import RigMap
from mapctl.retarget.recognition import body_plan
from mapctl.retarget.recognition.doubt import Doubt
from mapctl.retarget.rig_poses import RigPoses
from mapctl.skeleton import CANONICAL, Skeleton

_HALVES = (0.5, 2.0)  # of an upper limb's bone by the lower one
_SIDES = 1.2  # of a bone by that of the other side
_MIN_DIFFERENCE = 0.02  # metres by which bones of both sides differ at least, to differ
_ARM_BY_LEG = (0.35, 1.4)
_TRUNK_BY_LEG = (0.25, 1.4)
_HIPS_METRES = (0.4, 1.6)  # metres of the hips over the toes, of people
_MAX_SINK = 0.03  # metres that a joint of the trunk may be under the one before
_NO_BONE = 0.01  # metres of a bone that is none
_UPRIGHT = 0.5  # cosine between a body and the vertical, below which it lies

Places = dict[str, Float[Tensor, "3"]]
"""Positions in the T-pose by canonical name, metres, Y up, facing +Z."""


def check_bones(skeleton: Skeleton) -> Iterator[Doubt]:
    """Check the bones of canonical joints, as they are in the T-pose that was found."""
    places = _tpose_places(skeleton)
    yield from _compare_halves(skeleton)
    yield from _compare_sides(skeleton)
    yield from _compare_limbs(places)
    yield from _check_order(places)


def check_poses(rigmap: RigMap, clip: RigPoses | None) -> Iterator[Doubt]:
    """Check what a clip shows: an upright body, and a T-pose that agrees with it."""
    if clip is None:
        return
    up = clip.up()
    if rigmap.upright_quat_xyzw is not None:
        up = rotations.rotate(rigmap.upright_quat_xyzw.expand(len(up), 4), up)
    if body_plan.stays_on_all_fours(clip):
        yield Doubt("hands stand beside the feet under a level trunk in the whole clip: this may be an animal")
    elif float(up[:, 1].median()) < _UPRIGHT:
        yield Doubt(f"the body lies or hangs upside down in most frames if {rigmap.up} is up")
    if rigmap.tpose_doubt:
        yield Doubt(rigmap.tpose_doubt)


def _compare_halves(skeleton: Skeleton) -> Iterator[Doubt]:
    for side in ("left", "right"):
        for limb, upper, lower in (("arm", "LowerArm", "Hand"), ("leg", "LowerLeg", "Foot")):
            halves = _length(skeleton, side + upper), _length(skeleton, side + lower)
            joints = (side + upper, side + lower)
            if min(halves) < _NO_BONE:
                yield Doubt(f"{joints[halves.index(min(halves))]} is in the place of the joint above it", joints)
            elif not _HALVES[0] <= halves[0] / halves[1] <= _HALVES[1]:
                centimetres = " and ".join(f"{100 * half:.0f} cm" for half in halves)
                yield Doubt(f"the {side} {limb} has halves of {centimetres}", joints)


def _compare_sides(skeleton: Skeleton) -> Iterator[Doubt]:
    for name in CANONICAL.names:
        if name.startswith("left") and not name.endswith(("Toes", "Shoulder")):
            other = name.replace("left", "right")
            own, theirs = _length(skeleton, name), _length(skeleton, other)
            short, long = sorted((own, theirs))
            if long > _SIDES * short and long - short > _MIN_DIFFERENCE:
                said = f"{100 * own:.0f} and {100 * theirs:.0f} cm"
                yield Doubt(f"the bones to {name} and {other} differ: {said}", (name, other))


def _compare_limbs(places: Places) -> Iterator[Doubt]:
    legs = [_way(places, side + "UpperLeg", side + "LowerLeg", side + "Foot") for side in ("left", "right")]
    arms = [_way(places, side + "UpperArm", side + "LowerArm", side + "Hand") for side in ("left", "right")]
    leg, arm = sum(legs) / 2, sum(arms) / 2
    if leg < _NO_BONE:
        return
    trunk = float(((places["leftUpperArm"] + places["rightUpperArm"]) / 2 - places["hips"]).norm())
    for name, own, allowed in (("arms", arm, _ARM_BY_LEG), ("trunk", trunk, _TRUNK_BY_LEG)):
        if not allowed[0] <= own / leg <= allowed[1]:
            verb = "are" if name == "arms" else "is"
            yield Doubt(f"{name} {verb} {100 * own:.0f} cm long and legs {100 * leg:.0f} cm")
    low = min(float(places[side + "Toes"][1]) for side in ("left", "right"))
    height = float(places["hips"][1]) - low
    if not _HIPS_METRES[0] <= height <= _HIPS_METRES[1]:
        yield Doubt(f"hips are {height:.2f} m over the toes: the unit may be wrong")


def _check_order(places: Places) -> Iterator[Doubt]:
    """Check that the trunk goes up, shoulders are over the hips, and left is on the left."""
    trunk = [name for name in ("hips", "spine", "chest", "neck", "head") if name in places]
    for below, above in pairwise(trunk):
        if float(places[above][1] - places[below][1]) < -_MAX_SINK:
            yield Doubt(f"{above} is below {below} in the T-pose", (below, above))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        if float(places[side + "UpperArm"][1]) < float(places["hips"][1]):
            yield Doubt(f"{side}UpperArm is below the hips in the T-pose", (side + "UpperArm",))
        for part in ("UpperArm", "UpperLeg"):
            if sign * float(places[side + part][0] - places["hips"][0]) < -_NO_BONE:
                yield Doubt(f"{side + part} is on the other side of the hips", (side + part,))


def _tpose_places(skeleton: Skeleton) -> Places:
    positions = RigPoses.zero(skeleton, range(CANONICAL.num_joints)).positions[0]
    return dict(zip(CANONICAL.names, positions, strict=True))


def _length(skeleton: Skeleton, name: str) -> float:
    """Return the length of the bone that leads to a canonical joint, metres."""
    return float(skeleton.offsets[CANONICAL.index(name)].norm())


def _way(places: Places, *names: str) -> float:
    return sum(float((places[b] - places[a]).norm()) for a, b in pairwise(names))
