"""Inverse kinematics: rotations of a skeleton whose bones keep their lengths, from joint positions.

From the root down, every joint is rotated from where its parent leaves it by as little as its children's directions
need. What positions do not determine (a bone's rotation about itself, and joints without children) stays as in the
initial motion, except for the plane in which an elbow or a knee bends: a bent limb shows it.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.skeleton import LIMBS, Limb, Skeleton

_BEND_THRESHOLD = 0.15  # sine of a limb's bend at which its plane counts half
_TINY = 1e-9
_STRAIGHT_MARGIN = 1e-4  # metres that a limb is kept from being straight
_BEND_OFFSET = 0.003  # metres that an elbow or a knee is off the line before it shows in which direction the limb bends
_TRUST_POWER = 8  # power of a proposed bone's share of its length: nine tenths of the length count half


def solve_inverse_kinematics(
    positions_world: Float[Tensor, "frames joints 3"],
    start_quat_xyzw: Float[Tensor, "frames joints 4"],
    skeleton: Skeleton,
    *,
    free: Bool[Tensor, "frames joints"] | None = None,
    root_position: Float[Tensor, "frames 3"] | None = None,
    limbs: Sequence[Limb] = (),
) -> Float[Tensor, "frames joints 4"]:
    """Solve for local rotations (xyzw) with which the joints come nearest to the target positions, metres.

    `start_quat_xyzw` are the initial local rotations; those that are not `free` stay. `root_position` is the first
    joint's where it is not its target. A limb that cannot reach points at its target. In `limbs` the effectors count,
    elbows and knees as far as their bones have their lengths (see `_solve_two_bones`), and the first bone rotates about
    itself with the plane in which the limb bends. RequestError for other shapes.
    """
    frames, joints = positions_world.shape[:2]
    if start_quat_xyzw.shape[:2] != (frames, joints) or joints != skeleton.num_joints:
        raise RequestError(
            f"positions {tuple(positions_world.shape)} and rotations {tuple(start_quat_xyzw.shape)} must be "
            f"of the same frames and of {skeleton.num_joints} joints"
        )
    offsets = skeleton.offsets.to(positions_world)
    start, bending = start_quat_xyzw.to(positions_world), {limb.upper: limb for limb in limbs}
    at, world, local = [positions_world[:, 0] if root_position is None else root_position], [], []
    for joint, parent in enumerate(skeleton.parents):
        above = None if parent < 0 else world[parent]
        if above is not None:
            at.append(at[parent] + rotations.rotate(above, offsets[joint]))
        turn = start[:, joint] if above is None else rotations.multiply(above, start[:, joint])
        children = skeleton.children(joint)
        if joint in bending and bending[joint].shown:
            lower = bending[joint].lower
            ends = torch.tensor([lower, bending[joint].end])
            reached = _solve_two_bones(bending[joint], turn, start[:, lower], at[joint], positions_world, offsets)
            positions_world = positions_world.index_copy(1, ends, reached)
        if children:
            aims = [positions_world[:, child] - at[joint] for child in children]
            found = _align_bones(turn, [offsets[child] for child in children], aims)
            if joint in bending:
                found = _align_bend_plane(found, start, skeleton, children[0], positions_world, at[joint])
            turn = found if free is None else torch.where(free[:, joint, None], found, turn)
        world.append(turn)
        local.append(turn if above is None else rotations.multiply(rotations.inverse(above), turn))
    return rotations.make_sign_continuous(torch.stack(local, dim=1))


def _solve_two_bones(
    limb: Limb,
    turn: Float[Tensor, "frames 4"],
    bent: Float[Tensor, "frames 4"],
    at: Float[Tensor, "frames 3"],
    positions: Float[Tensor, "frames joints 3"],
    offsets: Float[Tensor, "joints 3"],
) -> Float[Tensor, "frames 2 3"]:
    """Return the positions of elbow or knee, and of the effector at its target as far as the bones reach.

    A proposal that is the mean of several poses has short bones, and a short forearm may point anywhere, also where no
    arm bends. So the proposed elbow or knee counts only as far as its bones have their lengths; the rest is the bend of
    the initial limb (`turn` of its first joint in the world, `bent` of the second in the first), rotated toward the
    target.
    """
    upper, lower = offsets[limb.lower], offsets[limb.end]
    direction = positions[:, limb.end] - at
    usual, toward = _find_usual_middle(limb, turn, bent, direction, upper, lower)
    proposed = torch.stack(
        [positions[:, limb.lower] - positions[:, limb.upper], positions[:, limb.end] - positions[:, limb.lower]], dim=1
    )
    whole = (proposed.norm(dim=-1) / torch.stack([upper.norm(), lower.norm()])).amin(dim=1, keepdim=True).clamp(max=1)
    trust = whole**_TRUST_POWER
    side = trust * (positions[:, limb.lower] - at) + (1 - trust) * toward + _BEND_OFFSET * usual
    return torch.stack([at + each for each in _close_triangle(direction, side, upper, lower)], dim=1)


def reach(
    limb: Limb,
    turn: Float[Tensor, "*batch 4"],
    bent: Float[Tensor, "*batch 4"],
    direction: Float[Tensor, "*batch 3"],
    offsets: Float[Tensor, "*#batch joints 3"],
) -> tuple[Float[Tensor, "*batch 4"], Float[Tensor, "*batch 4"]]:
    """Bend limbs so that their effectors reach a `direction` from their first joints, metres, or point there.

    `turn` is the first joint's world rotation (xyzw) and `bent` the second's local one; both come back, rotated by as
    little as that takes.
    """
    upper, lower = (offsets[..., joint, :].expand(direction.shape) for joint in (limb.lower, limb.end))
    usual, toward = _find_usual_middle(limb, turn, bent, direction, upper, lower)
    middle, end = _close_triangle(direction, toward + _BEND_OFFSET * usual, upper, lower)
    turned = rotations.multiply(rotations.between_vectors(rotations.rotate(turn, upper), middle), turn)
    world = rotations.multiply(turned, bent)
    world = rotations.multiply(rotations.between_vectors(rotations.rotate(world, lower), end - middle), world)
    return turned, rotations.multiply(rotations.inverse(turned), world)


def _find_usual_middle(
    limb: Limb,
    turn: Float[Tensor, "*batch 4"],
    bent: Float[Tensor, "*batch 4"],
    direction: Float[Tensor, "*batch 3"],
    upper: Float[Tensor, "*#batch 3"],
    lower: Float[Tensor, "*#batch 3"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Return where elbow or knee go when the whole limb rotates toward a direction: where a straight one would bend,
    and the bone's vector."""
    knee = rotations.rotate(turn, upper)
    foot = knee + rotations.rotate(rotations.multiply(turn, bent), lower)
    toward = rotations.between_vectors(foot, direction)
    bend = upper.new_tensor(limb.bend_direction)
    return rotations.rotate(rotations.multiply(toward, turn), bend), rotations.rotate(toward, knee)


def _close_triangle(
    direction: Float[Tensor, "*batch 3"],
    side: Float[Tensor, "*batch 3"],
    upper: Float[Tensor, "*#batch 3"],
    lower: Float[Tensor, "*#batch 3"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Return elbow or knee, on one side, and the effector along a direction as far as two bones reach."""
    long, short = (bone.norm(dim=-1, keepdim=True) for bone in (upper, lower))
    distance = direction.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    axis = direction / distance
    distance = distance.clamp(min=(long - short).abs() + _STRAIGHT_MARGIN, max=long + short - _STRAIGHT_MARGIN)
    side = torch.nn.functional.normalize(side - (side * axis).sum(-1, keepdim=True) * axis, dim=-1)
    along = (long.square() - short.square() + distance.square()) / (2 * distance)
    return along * axis + (long.square() - along.square()).clamp_min(0).sqrt() * side, distance * axis


def _align_bones(
    turn: Float[Tensor, "frames 4"], bones: Sequence[Float[Tensor, "3"]], aims: Sequence[Float[Tensor, "frames 3"]]
) -> Float[Tensor, "frames 4"]:
    """Rotate `turn` further so that the bones point along the aims: one bone exactly, several by least squares."""
    pointing = [rotations.rotate(turn, bone) for bone in bones]
    if len(bones) == 1:
        return rotations.multiply(rotations.between_vectors(pointing[0], aims[0]), turn)
    # Kabsch: the rotation that brings one set of vectors nearest to the other.
    product = sum(torch.einsum("ti,tj->tij", aim, bone) for aim, bone in zip(aims, pointing, strict=True))
    assert isinstance(product, Tensor)
    left, _, right = torch.linalg.svd(product)
    sign = torch.det(left @ right)
    flip = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1))
    return rotations.multiply(rotations.from_matrix(left @ flip @ right), turn)


def _align_bend_plane(
    turn: Float[Tensor, "frames 4"],
    start: Float[Tensor, "frames joints 4"],
    skeleton: Skeleton,
    child: int,
    positions: Float[Tensor, "frames joints 3"],
    at: Float[Tensor, "frames 3"],
) -> Float[Tensor, "frames 4"]:
    """Rotate `turn` about its bone so that the child bends in the plane that its own child's target asks for."""
    below = skeleton.children(child)
    if len(below) != 1:
        return turn
    offsets = skeleton.offsets.to(positions)
    bone = rotations.rotate(turn, offsets[child])
    knee = at + bone
    would = rotations.rotate(rotations.multiply(turn, start[:, child]), offsets[below[0]])
    axis = torch.nn.functional.normalize(bone, dim=-1)
    wanted = positions[:, below[0]] - knee
    would, wanted = (torch.nn.functional.normalize(vector, dim=-1) for vector in (would, wanted))
    would, wanted = (vector - (vector * axis).sum(-1, keepdim=True) * axis for vector in (would, wanted))
    angle = torch.atan2((torch.linalg.cross(would, wanted) * axis).sum(-1), (would * wanted).sum(-1) + _TINY)
    # A straight limb has no plane: the smaller of the two bends is the weight.
    bend = torch.minimum(would.norm(dim=-1), wanted.norm(dim=-1))
    weight = bend.square() / (bend.square() + _BEND_THRESHOLD**2)
    return rotations.multiply(rotations.from_rotation_vector(axis * (angle * weight)[:, None]), turn)


_DETOUR = 0.8  # share of the turn outwards that a turn between opposite directions takes
_OWN_SIDE = 0.5  # of the turn outwards that leads to a limb's own side, where 1 leads ahead


def find_out(name: str, joints: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames 3"]:
    """Find the unit vectors that lead level ahead of the shoulders, and somewhat to the own side of a hand or foot,
    from world positions of canonical joints."""
    left, right = (joints[:, LIMBS[side].upper] for side in ("leftHand", "rightHand"))
    across = torch.nn.functional.normalize((left - right) * joints.new_tensor([1.0, 0.0, 1.0]), dim=-1)
    ahead = torch.stack([-across[:, 2], torch.zeros_like(across[:, 0]), across[:, 0]], dim=-1)
    side = _OWN_SIDE if name.startswith("left") else -_OWN_SIDE
    return torch.nn.functional.normalize(ahead + side * across, dim=-1)


def bend_within(
    away: Float[Tensor, "frames 3"], length: float, *, easy: float, most: float
) -> Float[Tensor, "frames 3"]:
    """Bring vectors, metres, smoothly to where a limb of some length reaches them without being stretched: a stretched
    elbow swings fast. From the share `easy` of the length on they are shortened, to the share `most` at last."""
    far = away.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    bent, soft = easy * length, (most - easy) * length
    near = torch.where(far > bent, bent + soft * (1 - torch.exp(-(far - bent).clamp_min(0) / soft)), far)
    return away / far * near


def lead_about(
    one: Float[Tensor, "frames 3"],
    other: Float[Tensor, "frames 3"],
    share: Float[Tensor, " frames"],
    *,
    out: Float[Tensor, "frames 3"],
) -> Float[Tensor, "frames 3"]:
    """Turn one vector toward another by a share, its length by the same share; by way of `out`, a unit vector that
    leads away from the body, the more the two differ: a straight turn from a hand at one's side to a position overhead
    has no direction of its own, and flips."""
    lengths = [vector.norm(dim=-1, keepdim=True).clamp_min(1e-6) for vector in (one, other)]
    begin, end = one / lengths[0], other / lengths[1]
    apart = (1 - (begin * end).sum(-1, keepdim=True)) / 2
    middle = torch.nn.functional.normalize(begin + end + 2 * _DETOUR * apart * out, dim=-1)
    share = share[:, None]
    turned = _turn_toward(_turn_toward(begin, middle, share), _turn_toward(middle, end, share), share)
    return turned * torch.lerp(lengths[0], lengths[1], share)


def _turn_toward(
    one: Float[Tensor, "frames 3"], other: Float[Tensor, "frames 3"], share: Float[Tensor, "frames 1"]
) -> Float[Tensor, "frames 3"]:
    """Turn unit vectors toward others by a share of the angle between them (Shoemake 1985)."""
    angle = torch.atan2(torch.linalg.cross(one, other).norm(dim=-1, keepdim=True), (one * other).sum(-1, keepdim=True))
    near = angle.clamp_min(1e-6)
    turned = (torch.sin((1 - share) * near) * one + torch.sin(share * near) * other) / torch.sin(near)
    return torch.nn.functional.normalize(torch.where(angle > 1e-4, turned, torch.lerp(one, other, share)), dim=-1)
