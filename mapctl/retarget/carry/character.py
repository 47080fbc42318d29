"""The character that motion is put on, and the canonical joints of legs and arms by side."""

from dataclasses import dataclass, replace
from functools import cached_property

from mapctl.motion import Motion
from mapctl.retarget import RigMap, from_canonical, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.retarget.stance import SIDES, Stance
from mapctl.skeleton import CANONICAL, Skeleton

HIP_JOINTS, SHINS, FEET, TOES = (
    [CANONICAL.index(side + part) for side in SIDES] for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")
)


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

    def on_rig(self, motion: Motion) -> Motion:
        """Put a canonical motion of this body on its rig, in its file's layout; joints that are not canonical rest."""
        return replace(from_canonical(motion, self.rigmap), source=self.source)
