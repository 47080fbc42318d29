"""The pose of a body in the world: root position, heading, tilt and joint rotations, over frames and batches.

Conversions to and from features of a prior (Wang et al. 2019, Eq. 2-4), rotations, joint positions and motions are here
alone.
"""

from dataclasses import dataclass
from fractions import Fraction

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, FEET, Skeleton, find_heels


@dataclass(frozen=True, eq=False)
class BodyPose:
    """Poses of a body of canonical joints, frame by frame."""

    root_position: Float[Tensor, "*batch frames 3"]
    """World position of the hips, metres."""
    heading: Float[Tensor, "*batch frames"]
    """Heading of the hips about +Y, radians, not wrapped."""
    tilt_xz: Float[Tensor, "*batch frames 2"]
    """Rotation vector (x and z) of what remains of the hips' rotation without the heading, radians."""
    joint_rotvec: Float[Tensor, "*batch frames others 3"]
    """Rotation vectors of all other joints in their parents' frames, radians."""

    @staticmethod
    def of_features(features: Float[Tensor, "*batch frames size"], start: GroundPose) -> "BodyPose":
        """Return the poses that features describe, from the ground pose of the frame before the first."""
        return BodyPose.of_features_at(features, *integrate_root(features, start))

    @staticmethod
    def of_features_at(
        features: Float[Tensor, "*batch frames size"],
        root_xz_world: Float[Tensor, "*batch frames 2"],
        heading: Float[Tensor, "*batch frames"],
    ) -> "BodyPose":
        """Return the poses that features describe over these points of the ground, metres, facing these headings,
        radians."""
        height = LAYOUT.pick(features, "root_height")
        root = torch.cat([root_xz_world[..., :1], height, root_xz_world[..., 1:]], dim=-1)
        return BodyPose(root, heading, *_pick_rotations(features))

    @staticmethod
    def of_features_in_place(features: Float[Tensor, "*batch frames size"]) -> "BodyPose":
        """Return the poses that features describe, every frame over the origin and facing +Z."""
        height = LAYOUT.pick(features, "root_height")
        root = torch.cat([torch.zeros_like(height), height, torch.zeros_like(height)], dim=-1)
        return BodyPose(root, torch.zeros_like(height[..., 0]), *_pick_rotations(features))

    @staticmethod
    def of_motion(motion: Motion) -> "BodyPose":
        """Return the poses of a canonical motion, single precision."""
        heading, tilt = rotations.split_heading(motion.local_quat_xyzw[:, 0])
        return BodyPose(
            motion.root_position.float(),
            rotations.unwrap_angle(heading).float(),
            rotations.to_rotation_vector(tilt)[:, ::2].float(),
            rotations.to_rotation_vector(motion.local_quat_xyzw[:, 1:]).float(),
        )

    @staticmethod
    def unpack(packed: Float[Tensor, "*batch frames width"]) -> "BodyPose":
        """Invert `pack`."""
        joints = packed[..., 6:].unflatten(-1, (-1, 3))
        return BodyPose(packed[..., :3], packed[..., 3], packed[..., 4:6], joints)

    def pack(self) -> Float[Tensor, "*batch frames width"]:
        """Return the root position, heading and angles side by side."""
        return torch.cat([self.root_position, self.heading[..., None], self.angles], dim=-1)

    @property
    def angles(self) -> Float[Tensor, "*batch frames angles"]:
        """The tilt and the rotation vectors of all other joints side by side, as in the features, radians."""
        return torch.cat([self.tilt_xz, self.joint_rotvec.flatten(-2)], dim=-1)

    @property
    def rotation_vectors(self) -> Float[Tensor, "*batch frames joints 3"]:
        """Rotation vectors of all joints, the hips' without their heading, radians."""
        x, z = self.tilt_xz.unbind(dim=-1)
        return torch.cat([torch.stack([x, torch.zeros_like(x), z], dim=-1)[..., None, :], self.joint_rotvec], dim=-2)

    @property
    def local_quat_xyzw(self) -> Float[Tensor, "*batch frames joints 4"]:
        """Local rotations of all joints; the hips' is the heading times the tilt."""
        quats = rotations.from_rotation_vector(self.rotation_vectors)
        hips = rotations.multiply(rotations.about_y(self.heading), quats[..., 0, :])
        return torch.cat([hips.unsqueeze(-2), quats[..., 1:, :]], dim=-2)

    def joints_world(self, skeleton: Skeleton = CANONICAL) -> Float[Tensor, "*batch frames joints 3"]:
        """Return the world joint positions by forward kinematics on a skeleton's bones, metres."""
        matrices = rotations.rotation_vector_to_matrix(self.rotation_vectors)
        return self._place_in_world(kinematics.positions_from_matrices(skeleton, matrices))

    def joints_and_heels(
        self, skeleton: Skeleton = CANONICAL
    ) -> tuple[Float[Tensor, "*batch frames joints 3"], Float[Tensor, "*batch frames 2 3"]]:
        """Return the world joint positions, and those of the left and the right heel, metres."""
        matrices = rotations.rotation_vector_to_matrix(self.rotation_vectors)
        joints, turns = kinematics.chain_matrices(skeleton.offsets.to(matrices), skeleton.parents, matrices)
        feet = skeleton.indices(FEET)
        levers = (turns[..., feet, :, :] * find_heels(skeleton).to(turns)[:, None, :]).sum(-1)
        return self._place_in_world(joints), self._place_in_world(joints[..., feet, :] + levers)

    def _place_in_world(self, relative: Float[Tensor, "*batch frames points 3"]) -> Tensor:
        """Turn positions relative to hips that face +Z by the heading, and put them where the hips are."""
        ground = rotations.rotate_ground(relative[..., ::2], self.heading[..., None])
        turned = torch.stack([ground[..., 0], relative[..., 1], ground[..., 1]], dim=-1)
        return turned + self.root_position[..., None, :]

    def features(
        self, before: GroundPose, contacts: Bool[Tensor, "*#batch frames 2"]
    ) -> Float[Tensor, "*batch frames size"]:
        """Return the features whose integration from `before`, the ground pose of the frame before the first, leads
        here."""
        batch = self.heading.shape[:-1]
        ground = torch.cat([before.position_xz.expand(*batch, 1, 2), self.root_position[..., ::2]], dim=-2)
        heading = torch.cat([before.heading.expand(*batch, 1), self.heading], dim=-1)
        step = rotations.rotate_ground(torch.diff(ground, dim=-2), -heading[..., :-1])
        turn = torch.diff(heading, dim=-1)[..., None]
        bits = contacts.expand(*batch, -1, -1).to(step)
        return torch.cat([step, turn, self.root_position[..., 1:2], self.angles, bits], dim=-1)

    def slice(self, start: int, stop: int) -> "BodyPose":
        """Return frames start to stop."""
        part = slice(start, stop)
        return BodyPose(
            self.root_position[..., part, :],
            self.heading[..., part],
            self.tilt_xz[..., part, :],
            self.joint_rotvec[..., part, :, :],
        )

    def motion(self, skeleton: Skeleton = CANONICAL, fps: Fraction = Fraction(PRIOR_FPS)) -> Motion:
        """Return the unbatched poses as a motion on a skeleton of canonical joints, double precision."""
        quats = rotations.make_sign_continuous(self.local_quat_xyzw.double())
        return Motion(skeleton, fps, self.root_position.double(), quats)


def decode(features: Float[Tensor, "frames size"], start: GroundPose, *, skeleton: Skeleton = CANONICAL) -> Motion:
    """Return the canonical motion at PRIOR_FPS that features describe from `start`, in double precision; inverse of
    `features.encode` at that rate.
    """
    double = GroundPose(start.position_xz.double(), start.heading.double())
    return BodyPose.of_features(features.detach().double(), double).motion(skeleton)


def _pick_rotations(
    features: Float[Tensor, "*batch size"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch others 3"]]:
    return LAYOUT.pick(features, "root_tilt"), LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))
