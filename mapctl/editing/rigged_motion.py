"""A motion on its own rig, put upright, with which of its joints are canonical ones.

Legs of any rig brought to where their ankles are wanted, by thigh and shin alone; feet keep their orientation.

A leg that is where it is wanted stays to within rounding, so that frames without a change have none.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.kinematics.moving import rotate_world
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.retarget import RigMap
from mapctl.retarget.character import LEGS, SIDES, limb_extension
from mapctl.retarget.hands import soft_clamp
from mapctl.retarget.legs import FREE_EXTENSION, MAX_EXTENSION, find_missing_length
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

_SAME = 1e-12  # difference of rotations (xyzw) and lengths (metres) that rounding leaves


@dataclass(frozen=True, eq=False)
class RiggedMotion:
    """A motion on its own rig in a world with Y up."""

    motion: Motion
    """The motion, put upright."""
    rigmap: RigMap
    """Its rig, as of the file."""

    @staticmethod
    def of(motion: Motion, rig: Rig | None = None) -> "RiggedMotion":
        """Identify the rig and put the motion upright; RequestError where the rig's joints cannot be identified."""
        rigmap = retarget.identify_rig(motion.skeleton, rig, motion=motion)
        return RiggedMotion(rotate_world(motion, rigmap.upright_quat_xyzw), rigmap)

    def with_motion(self, motion: Motion) -> "RiggedMotion":
        """Return another upright motion of the same rig."""
        return RiggedMotion(motion, self.rigmap)

    @property
    def hips(self) -> int:
        return self.rigmap.joints["hips"]

    @cached_property
    def canonical(self) -> Motion:
        return retarget.to_canonical(self.motion, replace(retarget.as_rig(self.rigmap), up="y"))[0]

    def positions(self, part: str) -> Float[Tensor, "frames 2 3"]:
        """Return world positions, metres, of the left and right canonical joint of a part, as `Toes`.

        Where the rig has an End Site instead, or nothing, it is where the canonical body has it.
        """
        return torch.stack([self.position(side + part) for side in SIDES], dim=1)

    def position(self, name: str) -> Float[Tensor, "frames 3"]:
        """Return the world positions of one canonical joint, metres, as `positions` does."""
        joint = self.rigmap.joints.get(name)
        if joint is not None:
            return self.motion.joint_positions()[:, joint]
        index = CANONICAL.index(name)
        parent = CANONICAL.parents[index]
        bone = self.canonical.skeleton.offsets[index]
        turned = rotations.rotate(self.canonical.joint_rotations()[:, parent], bone)
        return self.position(CANONICAL.names[parent]) + turned

    def shift_hips(self, shift: Float[Tensor, "frames 3"]) -> Motion:
        """Return the upright motion with its hips, and all that they carry, shifted in the world, metres."""
        joint, moving = self.hips, self.motion.moving_offsets
        if joint not in moving:
            return replace(self.motion, root_position=self.motion.root_position + shift)
        above = self.motion.joint_rotations()[:, self.motion.skeleton.parents[joint]]
        own = moving[joint] + rotations.rotate(rotations.inverse(above), shift)
        return replace(self.motion, moving_offsets={**moving, joint: own})

    def in_file_world(self, like: Motion | None = None) -> Motion:
        """Return the motion in the world of its file. What is as in `like`, but for rounding, has its numbers."""
        up = self.rigmap.upright_quat_xyzw
        motion = rotate_world(self.motion, None if up is None else rotations.inverse(up))
        if like is None:
            return motion

        def keep(own: Tensor, other: Tensor, same: Tensor | None = None) -> Tensor:
            near = (own - other).abs().amax(dim=-1, keepdim=True) < _SAME
            return torch.where(near if same is None else near | same, other, own)

        own, other = motion.local_quat_xyzw, like.local_quat_xyzw
        opposite = (own + other).abs().amax(dim=-1, keepdim=True) < _SAME
        moving = {j: keep(track, like.moving_offsets.get(j, track)) for j, track in motion.moving_offsets.items()}
        root = keep(motion.root_position, like.root_position)
        return replace(motion, root_position=root, local_quat_xyzw=keep(own, other, opposite), moving_offsets=moving)


_SOFT_SHARE = 0.004  # of the leg, before the most that it may be, over which it gives in
_HIP_DROP_SECONDS = 0.12  # seconds over which hips go down for a leg that is too short, and up again
_FORWARD_SHARE = 0.1  # of an added bend, by how much it is where knees usually go rather than where this one went
_TINY = 1e-9


def place_ankles(rigged: RiggedMotion, ankles: Float[Tensor, "frames 2 3"]) -> Motion:
    """Return the upright motion with its ankles (left, right) at positions in the world, metres.

    Hips go down, smoothly and by as little as it takes, where a leg is too short. All local rotations stay, but those
    of upper legs, lower legs and feet.
    """
    dip = _find_hips_dip(rigged, ankles)
    if float(dip.max()) > 0:
        down = torch.stack([0 * dip, -dip, 0 * dip], dim=-1)
        rigged = rigged.with_motion(rigged.shift_hips(down))
    motion = rigged.motion
    local = motion.local_quat_xyzw.clone()
    for k, side in enumerate(SIDES):
        _place_ankle(rigged, side, ankles[:, k], local)
    return replace(motion, local_quat_xyzw=rotations.make_sign_continuous(local))


def _place_ankle(rigged: RiggedMotion, side: str, target: Float[Tensor, "frames 3"], local: Tensor) -> None:
    """Write the local rotations of one leg into `local`."""
    joints = [rigged.rigmap.joints[side + part] for part in ("UpperLeg", "LowerLeg", "Foot")]
    positions, world = rigged.motion.joint_positions(), rigged.motion.joint_rotations()
    at, knee, ankle = (positions[:, joint] for joint in joints)
    # The direction in the world in which the knee of a straight leg would bend.
    rest = rigged.rigmap.tpose_quat_xyzw[CANONICAL.index(side + "UpperLeg")]
    swung = rotations.multiply(world[:, joints[0]], rotations.inverse(rest))
    forward = rotations.rotate(swung, swung.new_tensor([0.0, 0.0, 1.0]))
    thigh_turn, shin_turn = _turn_leg(knee - at, ankle - knee, target - at, forward)
    parents = [rigged.motion.skeleton.parents[joint] for joint in joints]
    # What carries each joint has turned as the bone above it did, helper joints between the two included.
    turns = (None, thigh_turn, shin_turn)
    wanted = (
        rotations.multiply(thigh_turn, world[:, joints[0]]),
        rotations.multiply(shin_turn, world[:, joints[1]]),
        world[:, joints[2]],
    )
    moved = (target - ankle).abs().amax(-1) > _TINY
    for joint, parent, turn, goal in zip(joints, parents, turns, wanted, strict=True):
        above = world[:, parent] if turn is None else rotations.multiply(turn, world[:, parent])
        found = rotations.multiply(rotations.inverse(above), goal)
        local[:, joint] = torch.where(moved[:, None], found, local[:, joint])


def _turn_leg(
    thigh: Float[Tensor, "frames 3"],
    shin: Float[Tensor, "frames 3"],
    target: Float[Tensor, "frames 3"],
    forward: Float[Tensor, "frames 3"],
) -> tuple[Float[Tensor, "frames 4"], Float[Tensor, "frames 4"]]:
    """Return the rotations in the world of thigh and shin that bring their end to a target, all as vectors from the
    hip joint, metres. The knee stays in its plane; what it bends further goes a little more forward."""
    upper, lower, whole = thigh.norm(dim=-1), shin.norm(dim=-1), (thigh + shin).norm(dim=-1)
    # As far as it is wanted, and ever less beyond what is nearly the most. A leg that was straighter may stay so.
    wanted, length = target.norm(dim=-1), upper + lower
    most, soft = torch.maximum(MAX_EXTENSION * length, whole), _SOFT_SHARE * length
    limited = soft_clamp(wanted, most, soft)
    far = torch.where(wanted <= whole, wanted, torch.maximum(limited, torch.minimum(whole, wanted)))
    swing = rotations.between_vectors(thigh + shin, target)
    axis = torch.nn.functional.normalize(target, dim=-1)
    thigh, shin = rotations.rotate(swing, thigh), rotations.rotate(swing, shin)
    side = thigh - (thigh * axis).sum(-1, keepdim=True) * axis
    ahead = forward - (forward * axis).sum(-1, keepdim=True) * axis
    along = (upper.square() - lower.square() + far.square()) / (2 * far).clamp_min(_TINY)
    height = (upper.square() - along.square()).clamp_min(0).sqrt()
    added = (height - side.norm(dim=-1)).clamp_min(0)[:, None]
    direction = torch.nn.functional.normalize(side + _FORWARD_SHARE * added * ahead, dim=-1)
    knee = along[:, None] * axis + height[:, None] * direction
    turn = rotations.multiply(rotations.between_vectors(thigh, knee), swing)
    bent = rotations.rotate(rotations.multiply(turn, rotations.inverse(swing)), shin)
    return turn, rotations.multiply(rotations.between_vectors(bent, far[:, None] * axis - knee), turn)


def _find_hips_dip(rigged: RiggedMotion, ankles: Float[Tensor, "frames 2 3"]) -> Float[Tensor, " frames"]:
    """Find by how much hips go down for the legs to reach, metres, smooth over time; 0 where they reach anyway."""
    extension = limb_extension(rigged.canonical, LEGS).clamp(FREE_EXTENSION, MAX_EXTENSION)
    short, down = find_missing_length(rigged.canonical, ankles, extension)
    wanted = (ankles - rigged.positions("Foot")).norm(dim=-1) > _TINY
    short = torch.where((down > 0.5) & wanted, short.clamp_min(0), 0.0).amax(dim=-1)
    if float(short.max()) == 0:
        return short
    return gaussian.envelope(short[:, None], _HIP_DROP_SECONDS, float(rigged.motion.fps))[:, 0]
