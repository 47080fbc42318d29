"""Features of the prior: a motion without position and heading.

Wang et al. 2019, Eq. 2-4: per frame the root's displacement in the previous frame's heading frame, the heading change,
the root height, the remaining tilt of the root, and the joint rotations; and two contact bits (section 4.3). Rotation
vectors about the canonical T-pose replace the paper's Euler angles, near whose wraps real rigs lie.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.errors import MapctlError
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOES, mirror_name

PRIOR_FPS = 30
"""Frames per second of every prior: features are steps and turns a frame, so motions at other rates are resampled."""


@dataclass(frozen=True)
class FeatureLayout:
    """Named blocks of a feature vector, in order."""

    blocks: tuple[tuple[str, int], ...]
    """Name and width of each block, a number of features."""

    @cached_property
    def slices(self) -> Mapping[str, slice]:
        """Slice of each block."""
        slices, start = {}, 0
        for name, width in self.blocks:
            slices[name] = slice(start, start + width)
            start += width
        return slices

    @property
    def size(self) -> int:
        """Width of the whole vector, a number of features."""
        return sum(width for _, width in self.blocks)

    @property
    def continuous(self) -> int:
        """Width without the contact bits, which are the last block, a number of features."""
        return self.size - self.blocks[-1][1]

    def fingerprint(self) -> str:
        """Return a short hash of the blocks; a card holds it so that weights meet only the features they were trained
        on."""
        return sha256(repr(self.blocks).encode()).hexdigest()[:12]

    def pick(self, features: Float[Tensor, "*batch size"], block: str) -> Float[Tensor, "*batch width"]:
        """Select the named block of a feature tensor."""
        return features[..., self.slices[block]]


LAYOUT = FeatureLayout(
    (
        ("root_displacement_heading", 2),  # x and z, metres per frame, in the previous frame's heading frame
        ("heading_change", 1),  # radians per frame
        ("root_height", 1),  # metres
        ("root_tilt", 2),  # rotation vector (x, z) of what remains of the hips' rotation without its heading
        ("joint_rotations", 3 * (CANONICAL.num_joints - 1)),  # rotation vectors in the parent's frame
        ("contacts", 2),  # left and right toe planted, 0 or 1
    )
)
"""Features of a frame, 68 numbers: root displacement (x and z, metres) and heading change (radians) since the frame
before, root height (metres), root tilt (rotation vector, x and z), rotation vectors of 20 joints, two contact bits."""


@dataclass(frozen=True, eq=False)
class GroundPose:
    """Ground position and heading of the root."""

    position_xz: Float[Tensor, "*batch 2"]
    """Ground projection of the root, metres."""
    heading: Float[Tensor, "*batch"]
    """Heading, radians about +Y; 0 faces +Z."""

    def displace(self, displacement_heading: Float[Tensor, "*batch 2"], turn: Float[Tensor, "*batch"]) -> "GroundPose":
        """Displace in the own heading frame, then rotate: one step of Wang et al. 2019, Eq. 4."""
        step = rotations.rotate_ground(displacement_heading, self.heading)
        return GroundPose(self.position_xz + step, self.heading + turn)

    def before(self, displacement_heading: Float[Tensor, "*batch 2"], turn: Float[Tensor, "*batch"]) -> "GroundPose":
        """Return the pose from which one such step leads here."""
        heading = self.heading - turn
        return GroundPose(self.position_xz - rotations.rotate_ground(displacement_heading, heading), heading)

    @staticmethod
    def origin(dtype: torch.dtype = torch.float32) -> "GroundPose":
        """Return the pose at the origin, facing +Z."""
        return GroundPose(torch.zeros(2, dtype=dtype), torch.zeros((), dtype=dtype))


def encode(motion: Motion) -> tuple[Float[Tensor, "frames size"], GroundPose]:
    """Encode features of a canonical motion (float64), and the ground pose from which `pose.decode` leads back to it.

    The first frame has no past: it repeats the second frame's displacement, and the ground pose returned is that much
    before it. Raises MapctlError for other skeletons or fewer than two frames.
    """
    if motion.skeleton.names != CANONICAL.names:
        raise MapctlError("features are of canonical motion; use retarget.to_canonical first")
    if motion.num_frames < 2:
        raise MapctlError("features need at least two frames")
    heading, tilt = rotations.split_heading(motion.local_quat_xyzw[:, 0])
    ground = motion.root_position[:, [0, 2]]
    turn = rotations.wrap_angle(torch.diff(heading))
    step = rotations.rotate_ground(torch.diff(ground, dim=0), -heading[:-1])
    step, turn = torch.cat([step[:1], step]), torch.cat([turn[:1], turn])
    tilt_vector = rotations.to_rotation_vector(tilt)
    joints = rotations.to_rotation_vector(motion.local_quat_xyzw[:, 1:]).flatten(1)
    toes = CANONICAL.indices(TOES)
    planted = torch.as_tensor(contacts.detect_contacts(motion.joint_positions()[:, toes], float(motion.fps))).to(
        step.dtype
    )
    height = motion.root_position[:, 1:2]
    features = torch.cat([step, turn[:, None], height, tilt_vector[:, [0, 2]], joints, planted], dim=-1)
    return features, GroundPose(ground[0], heading[0]).before(step[0], turn[0])


def integrate_root(
    features: Float[Tensor, "*batch frames size"], start: GroundPose
) -> tuple[Float[Tensor, "*batch frames 2"], Float[Tensor, "*batch frames"]]:
    """Integrate root positions on the ground (metres) and headings (radians, not wrapped): Wang et al. 2019, Eq. 4."""
    turns = LAYOUT.pick(features, "heading_change")[..., 0]
    return integrate_steps(LAYOUT.pick(features, "root_displacement_heading"), turns, start)


def integrate_steps(
    steps_heading: Float[Tensor, "*batch frames 2"], turns: Float[Tensor, "*batch frames"], start: GroundPose
) -> tuple[Float[Tensor, "*batch frames 2"], Float[Tensor, "*batch frames"]]:
    """Integrate displacements (x, z, metres, each in the heading frame before it) and heading changes (radians) to
    positions on the ground and headings, not wrapped: Wang et al. 2019, Eq. 4."""
    heading = start.heading.unsqueeze(-1) + torch.cumsum(turns, dim=-1)
    steps = rotations.rotate_ground(steps_heading, heading - turns)
    return start.position_xz.unsqueeze(-2) + torch.cumsum(steps, dim=-2), heading


def ground_speed(features: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch"]:
    """Return the root's speed over the ground in each frame, m/s."""
    return LAYOUT.pick(features, "root_displacement_heading").norm(dim=-1) * PRIOR_FPS


def mirror_features(features: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch size"]:
    """Mirror features left to right."""
    swap = [CANONICAL.index(mirror_name(name)) - 1 for name in CANONICAL.names[1:]]
    vectors = LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))[..., swap, :]
    flip = features.new_tensor
    return torch.cat(
        [
            LAYOUT.pick(features, "root_displacement_heading") * flip([-1.0, 1.0]),
            -LAYOUT.pick(features, "heading_change"),
            LAYOUT.pick(features, "root_height"),
            LAYOUT.pick(features, "root_tilt") * flip([1.0, -1.0]),
            (vectors * flip([1.0, -1.0, -1.0])).flatten(-2),
            LAYOUT.pick(features, "contacts").flip(-1),
        ],
        dim=-1,
    )


def reversed_features(features: Float[Tensor, "*batch frames size"]) -> Float[Tensor, "*batch frames size"]:
    """Return the features of the motion run backwards, as `encode` finds them in it, in units of LAYOUT.

    A frame's step, turn and contacts are those by which it was reached, so backwards the frame after it has them: the
    step as -R(-turn) step, in the heading at which it ended, the turn as its negative, the contacts as they are. All
    else stays with its frame. The first frame repeats the second's, as in `encode`; how the given first frame was
    reached is dropped. The motion begins at `GroundPose.before` of the given last ground pose, by the first step and
    turn that are returned.

    Equal to `encode` of the reversed motion but for contacts, now and then, at the frame where one begins or ends: how
    low a toe is belongs to the frame, how slow it is to the step there, and features hold only whether it is both. For
    the side that walks back from the target (Ren et al. 2024, section 3.2). Raises MapctlError for fewer than two
    frames.
    """
    if features.shape[-2] < 2:
        raise MapctlError("features of a motion run backwards need at least two frames")
    back = features.flip(-2)
    left = torch.cat([back[..., :1, :], back[..., :-1, :]], dim=-2)  # how the frame after was reached
    turn = LAYOUT.pick(left, "heading_change")
    step = -rotations.rotate_ground(LAYOUT.pick(left, "root_displacement_heading"), -turn[..., 0])
    held = back[..., LAYOUT.slices["root_height"].start : LAYOUT.continuous]
    return torch.cat([step, -turn, held, LAYOUT.pick(left, "contacts")], dim=-1)
