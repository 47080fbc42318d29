"""Partial motions: what is known of a motion by joint, by frame and by kind, and an interpolation of the rest.

Known are rotations joint by joint; the position of the hips on the ground, their height and their heading, each for
itself; and a rough path of the hips. So lost joints, gaps, and keys that tell a part are one question to a network.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.numerics.intervals import fill_missing, fill_missing_angle, last_observed, next_observed
from mapctl.skeleton import CANONICAL

_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False)
class KnownParts:
    """Known parts of a batch of motions."""

    rotations: Bool[Tensor, "batch frames joints"]
    """Local rotations by joint; the hips' is their tilt without their heading."""
    heading: Bool[Tensor, "batch frames"]
    """Heading of the hips."""
    ground: Bool[Tensor, "batch frames"]
    """Position of the hips on the ground."""
    height: Bool[Tensor, "batch frames"]
    """Height of the hips."""
    path: Bool[Tensor, "batch frames"]
    """Whether an unknown position on the ground is shown roughly: the hips sway about it."""

    @staticmethod
    def whole(frames: Bool[Tensor, "batch frames"]) -> "KnownParts":
        """Whole poses in some frames, nothing in the others."""
        none = torch.zeros_like(frames)
        every = frames[..., None].expand(-1, -1, CANONICAL.num_joints)
        return KnownParts(every, frames, frames, frames, none)

    @property
    def root(self) -> Bool[Tensor, "batch frames"]:
        """Whether all of the hips' position is known."""
        return self.ground & self.height

    @property
    def positions(self) -> Bool[Tensor, "batch frames joints"]:
        """Whether a joint's world position is known: the hips' position and all rotations above are."""
        above = self.world_rotations
        known = [self.root]
        known += [self.root & above[..., parent] for parent in CANONICAL.parents[1:]]
        return torch.stack(known, dim=-1)

    @property
    def world_rotations(self) -> Bool[Tensor, "batch frames joints"]:
        """Whether a joint's world rotation is known."""
        known = [self.rotations[..., 0] & self.heading]
        for joint, parent in enumerate(CANONICAL.parents[1:], start=1):
            known.append(known[parent] & self.rotations[..., joint])
        return torch.stack(known, dim=-1)

    @property
    def everything(self) -> Bool[Tensor, "batch frames"]:
        """Whether nothing of a frame is unknown."""
        return self.rotations.all(dim=-1) & self.heading & self.root

    def mirrored(self) -> "KnownParts":
        """Exchange left and right."""
        return replace(self, rotations=self.rotations[..., _PARTNERS])


@dataclass(frozen=True, eq=False)
class PartialMotion:
    """A batch of motions of one length at PRIOR_FPS on canonical joints, interpolated where they are not known."""

    root_position: Float[Tensor, "batch frames 3"]
    """World position of the hips, metres."""
    heading: Float[Tensor, "batch frames"]
    """Heading of the hips about +Y, radians, not wrapped."""
    quats: Float[Tensor, "batch frames joints 4"]
    """Local rotations, xyzw; the hips' is their tilt, what is left without their heading."""
    contacts: Float[Tensor, "batch frames 2"]
    """Left and right toe planted, 0 or 1; 0.5 where the toe is not known."""
    offsets: Float[Tensor, "batch joints 3"]
    """Bones: each joint in its parent's frame, metres, of a body whose legs are as long as the canonical ones."""
    known: KnownParts
    """The known parts."""

    def local_matrices(self) -> Float[Tensor, "batch frames joints 3 3"]:
        """Return local rotation matrices; the hips' is their world rotation."""
        hips = rotations.multiply(rotations.about_y(self.heading), self.quats[..., 0, :])
        return rotations.to_matrix(torch.cat([hips.unsqueeze(-2), self.quats[..., 1:, :]], dim=-2))

    def world_poses(self) -> tuple[Float[Tensor, "batch frames joints 3"], Float[Tensor, "batch frames joints 3 3"]]:
        """Return world positions, metres, and world rotation matrices of all joints."""
        positions, world = kinematics.chain_matrices(self.offsets[:, None], CANONICAL.parents, self.local_matrices())
        return positions + self.root_position[..., None, :], world

    def slice(self, start: int, stop: int) -> "PartialMotion":
        """Return frames start to stop."""
        by_frame = ("root_position", "heading", "quats", "contacts")
        known = KnownParts(**{name: values[:, start:stop] for name, values in vars(self.known).items()})
        return replace(self, known=known, **{name: getattr(self, name)[:, start:stop] for name in by_frame})

    def mirrored(self) -> "PartialMotion":
        """Exchange left and right."""
        flip = self.root_position.new_tensor([-1.0, 1.0, 1.0])
        return PartialMotion(
            self.root_position * flip,
            -self.heading,
            mirror_quats(self.quats),
            self.contacts.flip(-1),
            self.offsets[..., _PARTNERS, :] * flip.to(self.offsets),
            self.known.mirrored(),
        )

    def with_mirror_image(self) -> "PartialMotion":
        """Return a batch of these motions and then their mirror images."""
        other = self.mirrored()
        known = {name: torch.cat([part, getattr(other.known, name)]) for name, part in vars(self.known).items()}
        values = {name: torch.cat([part, getattr(other, name)]) for name, part in vars(self).items() if name != "known"}
        return PartialMotion(**values, known=KnownParts(**known))


def interpolate_partial_motion(
    motion: PartialMotion, mean_quats: Float[Tensor, "joints 4"], mean_height: float
) -> PartialMotion:
    """Interpolate a motion where it is not known: rotations along the shortest arc from the last known frame to the
    next, positions and heading linearly; beyond the first and the last they are held. Unknown values may be anything
    finite, but a rough path is followed. What is known in no frame is the mean pose's, over the origin, facing +Z."""
    known, root = motion.known, motion.root_position
    shown = known.ground | known.path
    ground = _where_ever(shown, fill_missing(root[..., ::2], shown), 0.0)
    height = _where_ever(known.height, fill_missing(root[..., 1:2], known.height), mean_height)
    heading = _where_ever(known.heading, fill_missing_angle(motion.heading, known.heading)[..., None], 0.0)
    quats = interpolate_quats(motion.quats, known.rotations)
    ever = known.rotations.any(dim=1, keepdim=True)[..., None]
    return replace(
        motion,
        root_position=torch.cat([ground[..., :1], height, ground[..., 1:]], dim=-1),
        heading=heading[..., 0],
        quats=torch.where(ever, quats, mean_quats.to(quats)),
    )


def mirror_quats(quats: Float[Tensor, "*batch joints 4"]) -> Float[Tensor, "*batch joints 4"]:
    """Mirror local rotations (xyzw) through the body's sagittal plane."""
    return quats[..., _PARTNERS, :] * quats.new_tensor([1.0, -1.0, -1.0, 1.0])


def _where_ever(known: Bool[Tensor, "batch frames"], values: Tensor, otherwise: float) -> Tensor:
    return torch.where(known.any(dim=1)[:, None, None], values, otherwise)


def interpolate_quats(
    quats: Float[Tensor, "batch frames joints 4"], known: Bool[Tensor, "batch frames joints"]
) -> Float[Tensor, "batch frames joints 4"]:
    """Interpolate local rotations (xyzw) along the shortest arc from the last known frame to the next, joint by joint;
    beyond the first and the last they are held."""
    batch = len(quats)
    columns = known.transpose(1, 2).flatten(0, 1)
    before, after = last_observed(columns), next_observed(columns)
    missing = ~columns
    row, frame = missing.nonzero(as_tuple=True)
    start, stop = before[missing], after[missing]
    weight = ((frame - start).to(quats) / (stop - start).clamp_min(1)).clamp(0, 1)
    by_joint = quats.transpose(1, 2).flatten(0, 1)
    between = rotations.slerp(by_joint[row, start], by_joint[row, stop], weight)
    return by_joint.index_put((row, frame), between).unflatten(0, (batch, -1)).transpose(1, 2)
