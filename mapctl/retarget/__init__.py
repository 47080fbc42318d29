"""Conversion between a rig's own joint frames and the canonical ones, in both directions and without loss.

In the T-pose every canonical joint frame is aligned with the world. A rig's joint j then has some world rotation B_j,
and at any time: canonical world rotation = U * rig's world rotation * inverse(B_j), where U turns the file's world so
that Y is up. The canonical motion keeps the performer's own bone lengths; only the frames change.
"""

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import formats, kinematics, rotations
from mapctl.errors import RequestError
from mapctl.formats.character import CharacterSource
from mapctl.kinematics.moving import rotate_world
from mapctl.motion import Motion
from mapctl.retarget.anatomy import RigPoses
from mapctl.retarget.joint_matching import Match, correct_sides, match
from mapctl.retarget.reference_pose import TPose, find_tpose, is_canonical_tpose, measure_bones, rest_rotations
from mapctl.retarget.rigs import Rig, known_rigs, read_rig_toml
from mapctl.skeleton import CANONICAL, Skeleton


@dataclass(frozen=True, eq=False, kw_only=True)
class RigMap(TPose):
    """How one skeleton of a rig maps to canonical joints."""

    rig: Rig
    """The rig's names and T-pose."""
    rig_skeleton: Skeleton
    joint_of: tuple[int | None, ...]
    """For each canonical joint the rig's joint, None where the rig has only an End Site or nothing."""
    skeleton: Skeleton
    """Canonical names and tree with this performer's bones."""
    match: Match
    """Which of the rig's joints is which, and how sure that is."""
    hips_travel: bool = True
    """Whether hips below the root have an animated offset; else the root carries them."""

    @property
    def joints(self) -> dict[str, int]:
        """Index of the rig's joint by canonical name, of those that the rig has."""
        return {c: joint for c, joint in zip(CANONICAL.names, self.joint_of, strict=True) if joint is not None}

    @property
    def joint_names(self) -> dict[str, str]:
        """The rig's own joint name by canonical name, of those that the rig has."""
        return {c: self.rig_skeleton.names[joint] for c, joint in self.joints.items()}

    @property
    def rest_quat_xyzw(self) -> Float[Tensor, "rigged 4"]:
        """World rotations (xyzw) of the rig's joints in the T-pose, with Y up."""
        return rest_rotations(self.rig_skeleton, self.joint_of, self)


def load_rig(name_or_path: str | PathLike[str]) -> Rig:
    """Load a preset by its name, a rig from a TOML file, or the rig of a clip; RequestError if it is none of them."""
    text, path = str(name_or_path), Path(name_or_path)
    for rig in known_rigs():
        if rig.name == text.lower():
            return rig
    if path.suffix.lower() == ".toml":
        return read_rig_toml(path)
    if not path.suffix and not formats.is_example(path):
        names = ", ".join(rig.name for rig in known_rigs())
        raise RequestError(f"no rig {text!r}; known rigs: {names}; or name a TOML file or a clip")
    found = to_canonical(formats.load(path))[1]
    return replace(found.rig, joints=found.joint_names, aliases={})


def identify_rig(skeleton: Skeleton, rig: Rig | None = None, *, motion: Motion | None = None) -> RigMap:
    """Identify the rig's joints, its T-pose and its bones; RequestError where its joints cannot be identified.

    What `rig` states is taken as it is; where it names no joints, they are recognised: by presets, and then by names,
    tree and positions (see mapctl.retarget.joint_matching). A `motion` of the skeleton shows the up axis, the sides and
    how knees and elbows bend, and with that whether the T-pose of a preset or of the file is one.
    """
    source = None if motion is None else motion.source
    character = source if isinstance(source, CharacterSource) else None
    if character is not None and rig is None and character.humanoid:
        rig = Rig("vrm", character.humanoid, about="VRM: the file itself names its joints.")
    found = match(skeleton, rig, motion=motion)
    zero = RigPoses.zero(skeleton, found.joint_of)
    clip = None if motion is None else RigPoses.of(motion, found.joint_of)
    stated = rig is not None and bool(rig.joints) and rig not in known_rigs()
    if not stated:
        found = correct_sides(found, zero, clip)
        zero = replace(zero, joint_of=found.joint_of)
        clip = clip and replace(clip, joint_of=found.joint_of)
    if character is not None and not character.frames.are_aligned and found.rig in known_rigs():
        # A preset's table is of the rig's own joint frames, which are not those that a character's motion has.
        found = replace(found, rig=replace(found.rig, tpose={}, rest="auto"))
    # The canonical names in a T-pose are the canonical body, whatever it does.
    stated = stated or (found.rig.name == "canonical" and found.rig.rest == "tpose" and is_canonical_tpose(zero))
    up, own = (None, None) if character is None else ("y", torch.from_numpy(character.frames.quat_xyzw))
    tpose = find_tpose(zero, clip, rig=found.rig, stated=stated, up=up, own=own)
    rigmap = RigMap(
        **vars(tpose),
        rig=found.rig,
        rig_skeleton=skeleton,
        joint_of=found.joint_of,
        skeleton=measure_bones(skeleton, found.joint_of, tpose),
        match=found,
    )
    if motion is None:
        return rigmap
    # A character's rest pose shows no travel; a root on the floor is to stay there, not to rise and sink with the hips.
    return replace(rigmap, hips_travel=rigmap.joints["hips"] in motion.moving_offsets or character is not None)


def as_rig(rigmap: RigMap) -> Rig:
    """Return the rig as it was identified, so that parts of a clip are converted as the whole was.

    A part may lack the first frame that showed the T-pose, or the steps that showed how knees bend.
    """
    tpose = zip(CANONICAL.names, rigmap.tpose_quat_xyzw, strict=True)
    axes = {c: rotations.to_matrix(quat).T.tolist() for c, quat in tpose if c in rigmap.joints}
    return replace(
        rigmap.rig,
        joints=rigmap.joint_names,
        aliases={},
        tpose={c: {"x": x, "y": y} for c, (x, y, _) in axes.items()},
        idle=dict(zip(rigmap.rig_skeleton.names, rigmap.idle_quat_xyzw.tolist(), strict=True)),
        up=rigmap.up,
        rest="tpose",
    )


def to_canonical(motion: Motion, rig: Rig | RigMap | None = None) -> tuple[Motion, RigMap]:
    """Return the motion in canonical joint frames with the performer's own bones, and the map that leads back.

    `rig` wins over what would be recognised (see `identify_rig`); a map is taken as it is.
    """
    rigmap = rig if isinstance(rig, RigMap) else identify_rig(motion.skeleton, rig, motion=motion)
    world = motion.joint_rotations()
    picked = []
    for name, joint, tpose in zip(CANONICAL.names, rigmap.joint_of, rigmap.tpose_quat_xyzw, strict=True):
        if joint is None:  # an End Site rotates with its parent
            picked.append(picked[CANONICAL.parents[CANONICAL.index(name)]])
        else:
            picked.append(rotations.multiply(world[:, joint], rotations.inverse(tpose)))
    local = kinematics.local_from_world(CANONICAL.parents, torch.stack(picked, dim=1))
    hips = motion.joint_positions()[:, rigmap.joints["hips"]]
    found = Motion(rigmap.skeleton, motion.fps, hips, local, licence=motion.licence)
    found = rotate_world(found, rigmap.upright_quat_xyzw)
    return replace(found, local_quat_xyzw=rotations.make_sign_continuous(found.local_quat_xyzw)), rigmap


def rig_joint_positions(motion: Motion, rigmap: RigMap) -> Float[Tensor, "frames joints 3"]:
    """Return positions of the rig's own joints, by canonical joint, metres, in a world with Y up; 0 for joints it
    lacks.

    They differ from those of the canonical motion where joints that only the rig has, as those of twist, move them.
    """
    positions = motion.joint_positions()
    picked = [torch.zeros_like(positions[:, 0]) if joint is None else positions[:, joint] for joint in rigmap.joint_of]
    found = torch.stack(picked, dim=1)
    upright = rigmap.upright_quat_xyzw
    return found if upright is None else rotations.rotate(upright.expand(*found.shape[:2], 4), found)


def from_canonical(motion: Motion, rigmap: RigMap, original: Motion | None = None) -> Motion:
    """Convert a canonical motion to the rig. Joints that the canonical skeleton lacks keep the original's rotation.

    Without an original of the same length they rest (fingers straight). The result carries the original's file layout.
    """
    skeleton, frames = rigmap.rig_skeleton, motion.num_frames
    kept = original is not None and original.num_frames == frames
    rest = rigmap.idle_quat_xyzw.expand(frames, skeleton.num_joints, 4)
    own = original.local_quat_xyzw if original is not None and kept else rest
    targets, hips = motion.joint_rotations(), motion.root_position
    if rigmap.upright_quat_xyzw is not None:  # back to the file's world
        back = rotations.inverse(rigmap.upright_quat_xyzw)
        targets = rotations.multiply(back, targets)
        hips = rotations.rotate(back.expand(frames, 4), hips)
    pairs = enumerate(zip(rigmap.joint_of, rigmap.tpose_quat_xyzw, strict=True))
    wanted = {j: rotations.multiply(targets[:, c], b) for c, (j, b) in pairs if j is not None}
    local, world = [], []
    for joint, parent in enumerate(skeleton.parents):
        above = world[parent] if parent >= 0 else None
        turn = own[:, joint] if joint not in wanted else wanted[joint]
        if joint in wanted and above is not None:
            turn = rotations.multiply(rotations.inverse(above), wanted[joint])
        local.append(turn)
        world.append(turn if above is None else rotations.multiply(above, turn))
    on_rig = Motion(
        skeleton,
        motion.fps,
        torch.zeros(frames, 3, dtype=torch.float64),
        rotations.make_sign_continuous(torch.stack(local, 1)),
        source=original.source if original is not None else None,
        licence=motion.licence,
    )
    return _place_hips(on_rig, rigmap, hips, original if kept else None)


def _place_hips(on_rig: Motion, rigmap: RigMap, hips: Tensor, original: Motion | None) -> Motion:
    """Move the hips to target positions: by the root itself, or by their offset below it where that is animated."""
    joint = rigmap.joints["hips"]
    if original is not None:
        on_rig = replace(on_rig, root_position=original.root_position, moving_offsets=original.moving_offsets)
    if joint == 0:
        return replace(on_rig, root_position=hips)
    travel = rigmap.hips_travel if original is None else joint in original.moving_offsets
    if not travel:
        missed = hips - on_rig.joint_positions()[:, joint]
        return replace(on_rig, root_position=on_rig.root_position + missed)
    parent = on_rig.skeleton.parents[joint]
    turn, position = on_rig.joint_rotations()[:, parent], on_rig.joint_positions()[:, parent]
    offset = rotations.rotate(rotations.inverse(turn), hips - position)
    return replace(on_rig, moving_offsets={**on_rig.moving_offsets, joint: offset})


def canonical_joints(motion: Motion, rig: Rig | None = None) -> dict[str, int]:
    """Map canonical names to the joints of a motion's rig, those that it has; empty where the rig is not understood."""
    try:
        return identify_rig(motion.skeleton, rig, motion=motion).joints
    except RequestError:
        return {}


UNKNOWN_RIG_NOTE = "the rig is not known, and so not which way is up: taken as it is, with Y up"
"""Note on a motion that cannot be put upright."""


def put_upright(motion: Motion, rig: Rig | None = None) -> tuple[Motion, tuple[str, ...]]:
    """Put a motion on its own rig upright, with Y up; also return a note where the rig is not known.

    Unchanged where Y is up already, or nothing is known.
    """
    try:
        return rotate_world(motion, identify_rig(motion.skeleton, rig, motion=motion).upright_quat_xyzw), ()
    except RequestError:
        return motion, (UNKNOWN_RIG_NOTE,)
