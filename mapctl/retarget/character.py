"""The character that motion is put on, and how its performer stands: the height of the toe joints over the floor, and
the tilt of feet and toes while flat on it.

Both belong to the rig as much as bones do, and a T-pose alone does not show them: a table may lay a foot along another
performer's, and no toe joint is on the floor itself. A clip shows them, where its feet are planted; else the rest pose.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from os import PathLike

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, formats, kinematics, retarget, rotations
from mapctl.errors import MapctlError, RequestError
from mapctl.formats import bvh
from mapctl.motion import Motion
from mapctl.retarget import RigMap, from_canonical, to_canonical
from mapctl.retarget.anatomy import RigPoses, descendants
from mapctl.retarget.joint_matching import REQUIRED
from mapctl.retarget.reference_pose import axis_vector, frame_from_axes, upright_rotation
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, LIMBS, TOE_JOINTS, TOE_REST_HEIGHT, Limb, Skeleton, leg_length

SIDES = ("left", "right")
HIP_JOINTS, SHINS, FEET, TOES = (
    [CANONICAL.index(side + part) for side in SIDES] for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")
)
_MAX_FLOOR_OFFSET = 0.15  # of the leg: where toes rest further from 0, the floor is not at 0
_MIN_FLOOR_OFFSET = 0.03  # metres that toes rest higher than by the bones, which no toe joint's own height explains
MAX_TOE_SINK = 0.008
"""How far toe joints of a moving foot go under the height at which they rest at most, metres."""
_MAX_TOE_DIFFERENCE = 0.05  # of the leg: of toes that rest further apart, one is held up all the time
_FLAT_ANKLE_METRES = 0.01  # metres over its lowest that the ankle of a flat foot is
_LOWEST_QUANTILE = 0.05  # quantile that is an ankle's lowest
_MAX_TOE_DEPTH = 0.03  # metres that toes go through the floor at most, of a clip that counts
_MIN_FLAT_SECONDS = 0.25  # seconds of a flat foot from which its tilt is estimated
# Tilts outside are no error of the T-pose: a foot that points further down is on tip-toe.
_MIN_TILT, _MAX_TILT = math.radians(-12), math.radians(35)


@dataclass(frozen=True, eq=False)
class Stance:
    """How one performer stands on a flat floor, in canonical joint frames; feet in the order left, right."""

    toe_height: Float[Tensor, "2"]
    """Height of the toe joints over the floor while they rest on it, metres: as seen in a clip, its lowest."""
    flat_height: Float[Tensor, "2"]
    """Height of the toe joints over the floor while feet lie flat, metres: higher where toes sink in at times."""
    tilt: Float[Tensor, "2 2"]
    """Pitch of foot and toes by side, radians, positive up, against the T-pose while they lie flat."""
    floor: float = 0.0
    """Height of the clip's floor, metres: 0, but where all of it is above or below, as on a platform."""

    @property
    def standing_height(self) -> Float[Tensor, "2"]:
        """Height at which toe joints of others' flat feet are put over the floor, metres: as in the clip, but hardly
        over the height of toes that rest."""
        return torch.minimum(self.flat_height, self.toe_height + MAX_TOE_SINK)

    def keep_floor(self, skeleton: Skeleton) -> "Stance":
        """Return the stance of the same clip in which a floor that seems to be off is off, from 3 cm on: as on a low
        platform, on which toes rest higher than by the bones alone."""
        off = float((self.toe_height - Stance.at_rest(skeleton).toe_height).mean())
        off = off if abs(off) > _MIN_FLOOR_OFFSET else 0.0
        return Stance(self.toe_height - off, self.flat_height - off, self.tilt, self.floor + off)

    @staticmethod
    def at_rest(skeleton: Skeleton) -> "Stance":
        """Return the stance of bones alone: feet as in the T-pose, toes as high as the canonical in scale."""
        scale = leg_length(skeleton) / leg_length(CANONICAL)
        height = torch.full((2,), TOE_REST_HEIGHT * scale, dtype=torch.float64)
        return Stance(height, height, torch.zeros(2, 2).double())

    @staticmethod
    def of(clip: Motion, rigmap: RigMap) -> "Stance":
        """Measure the stance of a clip (canonical joints, from `to_canonical` with this map).

        Toes rest at a low percentile of their own height. A foot is flat where the toe is planted and the ankle at its
        lowest, and its tilt then is the T-pose's error: a T-pose whose feet point down is common. One that
        points down against the T-pose is more likely on tip-toe, and is accepted up to a few degrees only.
        """
        rest = Stance.at_rest(rigmap.skeleton)
        toes = clip.joint_positions()[:, TOES]
        seen, leg = contacts.estimate_floor_heights(toes), leg_length(rigmap.skeleton)
        if float((seen[0] - seen[1]).abs()) > _MAX_TOE_DIFFERENCE * leg:
            seen = seen.min().expand(2)
        flat = _detect_flat_feet(clip)
        tilt = _estimate_tilt(clip, flat)
        laid = torch.stack([toes[flat[:, k], k, 1].median() if flat[:, k].any() else seen[k] for k in range(2)])
        laid = laid.clamp(seen, seen + _MAX_TOE_DEPTH)
        if float(seen.abs().max()) > _MAX_FLOOR_OFFSET * leg:
            floor = float((seen - rest.toe_height).mean())
            return Stance(rest.toe_height, rest.toe_height + laid - seen, tilt, floor)
        return Stance(seen, laid, tilt)


def level_feet(clip: Motion) -> Motion:
    """Return the same movement (canonical joints) with joint frames of feet and toes that are aligned with the world
    while the foot is flat on the floor, as the clip shows it (see `Stance.of`); no joint moves."""
    return rotate_foot_frames(clip, -_estimate_tilt(clip, _detect_flat_feet(clip)))


def _rotations_about_x(pitch: Float[Tensor, "2 2"]) -> Float[Tensor, "joints 4"]:
    """Return rotations of feet and toes by these angles among those of all joints, which have none."""
    turns = rotations.from_rotation_vector(pitch[..., None] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(CANONICAL.num_joints, 1)
    still[FEET], still[TOES] = turns[:, 0], turns[:, 1]
    return still


def _rotate_bones(skeleton: Skeleton, turns: Float[Tensor, "joints 4"]) -> Skeleton:
    """Rotate the bones that begin at each joint."""
    parents = list(skeleton.parents)
    offsets = skeleton.offsets.clone()
    offsets[1:] = rotations.rotate(turns[parents[1:]], offsets[1:])
    ends = {}
    for name, site in skeleton.end_offsets.items():
        x, y, z = rotations.rotate(turns[skeleton.index(name)], torch.tensor(site, dtype=torch.float64)).tolist()
        ends[name] = (x, y, z)
    return replace(skeleton, offsets=offsets, end_offsets=ends)


def rotate_foot_frames(motion: Motion, pitch: Float[Tensor, "2 2"]) -> Motion:
    """Return the same movement with joint frames of feet and toes (by side) that are pitched, radians; no joint moves.

    With the negative tilt of its stance, feet are flat in a motion's T-pose; with the tilt itself they are as before.
    """
    by_joint = _rotations_about_x(pitch)
    world = rotations.multiply(motion.joint_rotations(), rotations.inverse(by_joint))
    local = rotations.make_sign_continuous(kinematics.local_from_world(CANONICAL.parents, world))
    return replace(motion, skeleton=_rotate_bones(motion.skeleton, by_joint), local_quat_xyzw=local)


def _detect_flat_feet(clip: Motion) -> Bool[Tensor, "frames 2"]:
    """Detect where feet lie flat; nowhere for a side that hardly ever does."""
    planted = contacts.detect_contacts(clip.joint_positions()[:, TOES], clip.fps)
    ankles = clip.joint_positions()[:, FEET, 1]
    flat = torch.zeros_like(planted)
    for k in range(2):
        if bool(planted[:, k].any()):
            lowest = torch.quantile(ankles[planted[:, k], k], _LOWEST_QUANTILE)
            flat[:, k] = planted[:, k] & (ankles[:, k] < lowest + _FLAT_ANKLE_METRES)
    return flat & (flat.sum(0) >= max(3.0, _MIN_FLAT_SECONDS * float(clip.fps)))


def _estimate_tilt(clip: Motion, flat: Bool[Tensor, "frames 2"]) -> Float[Tensor, "2 2"]:
    """Estimate the tilt of foot and toes by side, radians: its median over flat frames; 0 for a side without any."""
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turns = clip.joint_rotations()[:, [*FEET, *TOES]].reshape(-1, 2, 2, 4)
    up = torch.asin(rotations.rotate(turns, forward)[..., 1].clamp(-1, 1))
    found = [up[flat[:, k], :, k].median(dim=0).values for k in range(2) if flat[:, k].any()]
    if not found:
        return torch.zeros(2, 2, dtype=torch.float64)
    tilt = torch.stack(found if len(found) == 2 else found * 2)
    return torch.where((tilt > _MIN_TILT) & (tilt < _MAX_TILT), tilt, 0.0)


LEGS, ARMS = ([LIMBS[side + end] for side in SIDES] for end in ("Foot", "Hand"))


@dataclass(frozen=True, eq=False)
class RiggedCharacter:
    """The character that is to move: a rig with its performer's bones and stance."""

    rigmap: RigMap
    """The rig, and its bones on canonical joints."""
    stance: Stance
    """How the performer stands: toe heights, and tilt of the feet."""
    source: object | None = None
    """Layout and unit of the rig's file, which the result is written in."""

    @staticmethod
    def of(clip: Motion, rig: Rig | None = None) -> "tuple[Motion, RiggedCharacter]":
        """Return a clip on canonical joints, and its character; RequestError where its joints cannot be identified."""
        canonical, rigmap = to_canonical(clip, rig)
        return canonical, RiggedCharacter(rigmap, Stance.of(canonical, rigmap), clip.source)

    @property
    def skeleton(self) -> Skeleton:
        """Canonical names and tree with this performer's bones."""
        return self.rigmap.skeleton

    @cached_property
    def leveled_map(self) -> RigMap:
        """Between the rig and canonical joints whose T-pose has this performer's feet flat on the floor."""
        turns = _rotations_about_x(-self.stance.tilt)
        tpose = rotations.multiply(turns, self.rigmap.tpose_quat_xyzw)
        return replace(self.rigmap, tpose_quat_xyzw=tpose, skeleton=_rotate_bones(self.rigmap.skeleton, turns))

    @property
    def leveled(self) -> Skeleton:
        """Canonical skeleton with this performer's bones in the T-pose whose feet lie flat."""
        return self.leveled_map.skeleton

    def on_rig(
        self,
        motion: Motion,
        *,
        original: Motion | None = None,
        fingers: Mapping[int, Float[Tensor, "frames 4"]] | None = None,
    ) -> Motion:
        """Put a canonical motion of this body on its rig, in its file's layout.

        Joints that are not canonical turn as those of the `original`, of the same rig, or rest without one, but for
        `fingers`: local rotations (xyzw) by joint of the rig, none of which carries a canonical joint.
        """
        on_rig = from_canonical(motion, self.rigmap, original)
        local = on_rig.local_quat_xyzw.clone()
        for joint, turns in (fingers or {}).items():
            local[:, joint] = rotations.make_sign_continuous(turns)
        return replace(on_rig, local_quat_xyzw=local, source=self.source)


def limb_lengths(skeleton: Skeleton, limbs: Sequence[Limb]) -> Float[Tensor, " limbs"]:
    """Return the lengths of stretched limbs of canonical joints, metres."""
    return torch.tensor([limb.length(skeleton) for limb in limbs], dtype=torch.float64)


def limb_extension(own: Motion, limbs: Sequence[Limb]) -> Float[Tensor, "frames limbs"]:
    """Return how straight limbs are: from the first joint to the effector over both bones' length."""
    positions = own.joint_positions()
    reach = positions[:, [limb.end for limb in limbs]] - positions[:, [limb.upper for limb in limbs]]
    return reach.norm(dim=-1) / limb_lengths(own.skeleton, limbs)


_FPS, _FRAMES = Fraction(30), 30


def make_tpose_clip(rig: Rig) -> Motion:
    """Make a second of standing in the T-pose on the rig's joints, in its world and unit; toes on the floor.

    Bones are the canonical body's, since a rig has names and no lengths. RequestError where it lacks one of the names
    that are required.
    """
    missing = [name for name in REQUIRED if name not in rig.joints]
    if missing:
        raise RequestError(f"rig {rig.name} names no joint for {', '.join(missing)}; name them, or a clip")
    root = torch.zeros(_FRAMES, 3, dtype=torch.float64)
    root[:, 1] = TOE_REST_HEIGHT - RigPoses.zero(CANONICAL).positions[0, TOE_JOINTS[0], 1]
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(_FRAMES, CANONICAL.num_joints, 4)
    tpose = Motion(CANONICAL, _FPS, root, still.clone())
    standing = retarget.from_canonical(tpose, retarget.identify_rig(_build_skeleton(rig), rig))
    if rig.metres_per_unit is None:
        return standing
    layout = bvh.choose_layout(standing, rig.name)
    return replace(standing, source=replace(layout, metres_per_unit=rig.metres_per_unit))


def _build_skeleton(rig: Rig) -> Skeleton:
    """Build the joints that the rig names, depth first, as files nest them."""
    canonical, ends = RigPoses.zero(CANONICAL).positions[0], CANONICAL.end_offsets
    # Joints that no table has are along the file's axes.
    unnamed = torch.eye(3, dtype=torch.float64) if rig.tpose else _file_to_world(rig)
    found: list[tuple[str, int, Tensor, Tensor]] = []  # name, parent, position and axes in the world
    tips: dict[str, tuple[float, float, float]] = {}

    def visit(joint: int, parent: int) -> None:
        name, children = CANONICAL.names[joint], CANONICAL.children(joint)
        if name in rig.joints:
            for number, between in enumerate(rig.trunk if name == "chest" else (), start=1):
                share, spine = number / (len(rig.trunk) + 1), canonical[CANONICAL.index("spine")]
                found.append((between, parent, torch.lerp(spine, canonical[joint], share), found[parent][3]))
                parent = len(found) - 1
            axes, own = rig.tpose.get(name), rig.joints[name]
            found.append((own, parent, canonical[joint], frame_from_axes(axes) if axes else unnamed))
            parent = len(found) - 1
            if not any(CANONICAL.names[child] in rig.joints for child in children):
                end = canonical[children[0]] - canonical[joint] if children else torch.tensor(ends[name]).double()
                x, y, z = (found[parent][3].T @ end).tolist()
                tips[own] = (x, y, z)
        for child in children:
            visit(child, parent)

    visit(0, -1)
    names, parents, positions, frames = zip(*found, strict=True)
    offsets = [
        at if above < 0 else frames[above].T @ (at - positions[above])
        for above, at in zip(parents, positions, strict=True)
    ]
    return Skeleton(names, parents, torch.stack(offsets), tips)


def _file_to_world(rig: Rig) -> Float[Tensor, "3 3"]:
    """Return the rotation from the rig's world to one with Y up that faces +Z."""
    upright = None if rig.up == "auto" else upright_rotation(rig.up)
    up, front = axis_vector("y" if rig.up == "auto" else rig.up), axis_vector("z")
    if rig.facing != "auto" and abs(float(axis_vector(rig.facing) @ up)) < 0.5:
        front = axis_vector(rig.facing)
    elif upright is not None:
        front = rotations.rotate(rotations.inverse(upright), front)
    return torch.stack([torch.linalg.cross(up, front), up, front])


def load_standing_character(path: str | PathLike[str]) -> Motion | None:
    """Load a second of a character's standing in the rest pose of its file, its soles on the floor; None for files that
    have no rest pose of their own.

    Soles are the lowest vertices that feet carry; where the file has no triangles or its rig is not known, the floor is
    where it has it.
    """
    rest = formats.load_rest(path)
    if rest is None:
        return None
    sole = 0.0
    try:
        mesh = formats.load_mesh(path)
        rigmap = retarget.identify_rig(rest.skeleton, motion=rest)
    except MapctlError:
        pass
    else:
        below = descendants(rest.skeleton, [rigmap.joints[side + "Foot"] for side in SIDES])
        main = np.take_along_axis(mesh.joints, mesh.weights.argmax(axis=1)[:, None], axis=1)[:, 0]
        sole = float(mesh.vertices[np.isin(main, sorted(below)), 1].min(initial=np.inf))
    down = torch.tensor([0.0, sole if np.isfinite(sole) else 0.0, 0.0], dtype=torch.float64)
    standing = replace(rest, fps=_FPS, root_position=rest.root_position - down)
    return standing.pick(torch.zeros(_FRAMES, dtype=torch.long))
