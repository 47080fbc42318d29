"""The character that motion is put on, and the lengths of its legs and arms."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.retarget import RigMap, from_canonical, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.retarget.stance import SIDES, Stance
from mapctl.skeleton import LIMBS, Limb, Skeleton

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
        return self.stance.leveled_map(self.rigmap)

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
        made = from_canonical(motion, self.rigmap, original)
        local = made.local_quat_xyzw.clone()
        for joint, turns in (fingers or {}).items():
            local[:, joint] = rotations.make_sign_continuous(turns)
        return replace(made, local_quat_xyzw=local, source=self.source)


def limb_lengths(skeleton: Skeleton, limbs: Sequence[Limb]) -> Float[Tensor, " limbs"]:
    """Return the lengths of stretched limbs of canonical joints, metres."""
    return torch.tensor([limb.length(skeleton) for limb in limbs], dtype=torch.float64)


def limb_extension(own: Motion, limbs: Sequence[Limb]) -> Float[Tensor, "frames limbs"]:
    """Return how straight limbs are: from the first joint to the effector over both bones' length."""
    places = own.joint_positions()
    reach = places[:, [limb.end for limb in limbs]] - places[:, [limb.upper for limb in limbs]]
    return reach.norm(dim=-1) / limb_lengths(own.skeleton, limbs)
