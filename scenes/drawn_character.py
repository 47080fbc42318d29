"""A user's character, drawn with its own mesh in place of the mannequin, and any motion put on it for that."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from os import PathLike, fspath

from mapctl import formats
from mapctl.errors import RequestError
from mapctl.mesh.anatomy import Anatomy
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.mannequin import Body
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.retarget import as_rig, from_canonical, put_upright, to_canonical
from mapctl.retarget.carry import RiggedCharacter, retarget_canonical
from mapctl.retarget.character import load_standing_character

_SAME_BONE = 1e-4  # metres by which bones of one character may differ between files, which round


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A motion put on a character, to be filmed."""

    mesh: CharacterMesh
    motion: Motion
    """The motion on the joints of the character's file."""
    bones: Motion
    """The same on joints that are recognised: canonical ones, or the file's where they are all that is known."""
    notes: tuple[str, ...]
    """Parts of the motion that could not be kept, one sentence each."""
    put_on: Callable[[Motion], "DrawnMotion"]
    """Puts further frames of the same source on the character, as poses that are requested."""

    def build_body(self, fps: Fraction, colour: Array) -> Body:
        """Build the body at a film's rate; `colour` (red, green, blue, 0 to 1) is that of bones that are drawn."""
        bones = replace(self.bones, source=None).resample(fps)
        return Body(self.motion.resample(fps), self.mesh, Anatomy(bones), colour)


@dataclass(frozen=True, eq=False)
class DrawnCharacter:
    """A character's mesh and joints, as its file has them."""

    path: str
    """Its file, and what is chosen of it."""
    mesh: CharacterMesh
    standing: Motion
    """It stands on the floor in its rest pose."""

    @staticmethod
    def load(path: str | PathLike[str]) -> "DrawnCharacter":
        """Load the character of a file; `hero.glb#ARMATURE` chooses where there are several.

        FileFormatError where the file has none, or no triangles that its joints carry.
        """
        mesh = formats.load_mesh(path)
        standing = load_standing_character(path)
        assert standing is not None, "files with a mesh have a rest pose"
        return DrawnCharacter(fspath(path), mesh, standing)

    @cached_property
    def body(self) -> RiggedCharacter:
        """Its rig and stance; RequestError where its joints cannot be identified."""
        return RiggedCharacter.of(self.standing)[1]

    def check_rig(self) -> None:
        """Raise RequestError that names the file unless motions of other rigs can be put on it."""
        try:
            self.body  # noqa: B018 - computed once, and kept
        except RequestError as error:
            raise RequestError(f"{self.path}: {error}") from error

    def put_on(self, motion: Motion) -> DrawnMotion:
        """Put a motion of any rig on the character.

        One that is of this character already stays as it is; so does one of canonical joints with its bones. Others
        are retargeted (mapctl.retarget.carry), as by `mapctl convert --rig`. RequestError where the joints of either
        cannot be identified.
        """
        place = self._choose_conversion(motion)

        def put_on(own: Motion) -> DrawnMotion:
            return DrawnMotion(self.mesh, *place(own), put_on)

        return put_on(motion)

    def _choose_conversion(self, motion: Motion) -> Callable[[Motion], tuple[Motion, Motion, tuple[str, ...]]]:
        """Choose what puts such a motion on the character: on its own joints, on recognised ones, and with notes."""
        if motion.skeleton.matches(self.standing.skeleton, _SAME_BONE):
            return _keep
        for rigmap in (self.body.leveled_map, self.body.rigmap):
            if motion.skeleton.matches(rigmap.skeleton, _SAME_BONE):
                return lambda own: (replace(from_canonical(own, rigmap), source=self.standing.source), own, ())
        source = RiggedCharacter.of(motion)[1]

        def retarget(part: Motion) -> tuple[Motion, Motion, tuple[str, ...]]:
            done = retarget_canonical(to_canonical(part, as_rig(source.rigmap))[0], source, self.body)
            return self.body.on_rig(done.motion), done.motion, done.changes.notes

        return retarget


def _keep(motion: Motion) -> tuple[Motion, Motion, tuple[str, ...]]:
    upright = put_upright(motion)[0]
    try:
        return upright, to_canonical(upright)[0], ()
    except RequestError:  # a creature, whose joints are drawn all the same
        return upright, upright, ()
