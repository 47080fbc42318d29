"""A performer's bones on the canonical skeleton: the rig put into its T-pose, joint by joint."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.retarget.reference_pose import UNROTATED, TPose
from mapctl.retarget.rig_poses import JointOf, next_joint
from mapctl.skeleton import CANONICAL, Skeleton

_END_SITES = ("Toes", "Hand", "head")  # joints whose position an End Site of the joint above may give


def rest_rotations(skeleton: Skeleton, joint_of: JointOf, tpose: TPose) -> Float[Tensor, "rigged 4"]:
    """Return the world rotations (xyzw) of a rig's joints in the T-pose, with Y up; joints that are no canonical one
    rest in their parents."""
    canonical = {joint: tpose.tpose_quat_xyzw[c] for c, joint in enumerate(joint_of) if joint is not None}
    root = UNROTATED if tpose.upright_quat_xyzw is None else tpose.upright_quat_xyzw
    found: list[Tensor] = []
    for joint, parent in enumerate(skeleton.parents):
        above = found[parent] if parent >= 0 else root
        found.append(canonical.get(joint, rotations.multiply(above, tpose.idle_quat_xyzw[joint])))
    return torch.stack(found)


def measure_bones(skeleton: Skeleton, joint_of: JointOf, tpose: TPose) -> Skeleton:
    """Measure a rig's bones on the canonical skeleton, metres.

    A joint that the rig lacks is put where the End Site of the joint above is, between its neighbours, or, at the end
    of a limb, as far on as the canonical one in scale.
    """
    turn, place = rest_rotations(skeleton, joint_of, tpose), [torch.zeros(3, dtype=torch.float64)]
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        place.append(place[parent] + rotations.rotate(turn[parent], skeleton.offsets[joint]))
    ends = {}
    for name, site in skeleton.end_offsets.items():
        joint = skeleton.index(name)
        ends[joint] = rotations.rotate(turn[joint], torch.tensor(site, dtype=torch.float64))
    known = {c: place[joint] for c, joint in enumerate(joint_of) if joint is not None}
    spots: list[Tensor] = []
    for c in range(CANONICAL.num_joints):
        spots.append(known[c] if c in known else _estimate_position(c, joint_of, spots, known, ends))
    places = torch.stack(spots)
    offsets = torch.cat([torch.zeros(1, 3, dtype=torch.float64), places[1:] - places[list(CANONICAL.parents[1:])]])
    tips = {
        CANONICAL.names[c]: _to_triple(ends[j])
        for c, j in enumerate(joint_of)
        if j is not None and j in ends and not CANONICAL.children(c)
    }
    return Skeleton(CANONICAL.names, CANONICAL.parents, offsets, tips)


def _estimate_position(
    c: int, joint_of: JointOf, spots: list[Tensor], known: Mapping[int, Tensor], ends: Mapping[int, Tensor]
) -> Float[Tensor, "3"]:
    """Estimate the position of a joint that the rig lacks, metres."""
    name, parent = CANONICAL.names[c], CANONICAL.parents[c]
    above, own = joint_of[parent], float(CANONICAL.offsets[c].norm())
    if name.endswith(_END_SITES) and above is not None and above in ends:
        return spots[parent] + ends[above]
    length, following = own, next_joint(name)
    while following is not None:
        length += float(CANONICAL.offsets[CANONICAL.index(following)].norm())
        if CANONICAL.index(following) in known:
            return spots[parent] + (known[CANONICAL.index(following)] - spots[parent]) * (own / length)
        following = next_joint(following)
    return spots[parent] + CANONICAL.offsets[c] * _estimate_scale(spots)


def _estimate_scale(spots: list[Tensor]) -> float:
    """Estimate the performer's size relative to the canonical skeleton from the reach of the joints so far."""
    own = sum(float((spot - spots[CANONICAL.parents[c]]).norm()) for c, spot in enumerate(spots) if c)
    usual = float(CANONICAL.offsets[1 : len(spots)].norm(dim=-1).sum())
    return own / usual if own > 0 and usual > 0 else 1.0


def _to_triple(vector: Tensor) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
