"""`mapctl convert`: any format to any format, other bones, another frame rate."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import options, outputs
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from mapctl.motion import Motion
    from mapctl.retarget.carry import RetargetedMotion
    from mapctl.retarget.rigs import Rig


@dataclass(frozen=True)
class Convert:
    """Write a motion in another format, on another skeleton or at another frame rate."""

    source: options.InFile
    """.bvh, .npz, or .amc: its skeleton is the .asf of the same name, else the only one in the folder, else
    named as in subject.asf+take.amc."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """.bvh, .npz, or with a skinned body .glb, .usda, .usdc or .usd."""
    rig: Annotated[str | None, arg(metavar="canonical|PRESET|FILE.toml|CLIP")] = None
    """`canonical`: canonical joints with the performer's own bones; or a clip whose skeleton is wanted, on which the
    character stands on its floor with planted feet, in the clip's layout; or a rig by name or TOML file, whose joints
    get the bones of the canonical body."""
    source_rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    fps: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second, as 30, 29.97 or 30000/1001: positions linear, rotations by slerp."""
    fps_in: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second of an .amc, which does not say; 120 unless given."""

    def run(self) -> int:
        """Read, change, write."""
        from mapctl import formats

        formats.check_ending(self.out)
        outputs.check_files([self.out])
        fps = None if self.fps is None else parse_fps(self.fps)
        source_rig = options.read_rig(self.source_rig)
        fps_in = None if self.fps_in is None else parse_fps(self.fps_in)
        motion, notes = options.read_motion(self.source, source_rig, fps=fps_in), ()
        if self.rig is not None:
            carried = transfer_to_rig(motion, self.rig, source_rig)
            motion, notes = carried.motion, carried.notes
        if fps is not None:
            motion = motion.resample(fps)
        formats.save(motion, self.out)
        rate = f"{float(motion.fps):.6g} frames a second"
        print(f"{self.out}: {motion.num_frames} frames, {motion.num_joints} joints, {rate}")
        for note in notes:
            print(f"note: {note}")
        return 0


def parse_fps(text: str) -> Fraction:
    """A frame rate in any of the usual spellings; RequestError for what is none or beyond 1000."""
    try:
        fps = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"a frame rate is a number, as 30, 29.97 or 30000/1001, got {text!r}") from None
    if not Fraction(1, 100) <= fps <= 1000:
        raise RequestError(f"the frame rate must be 0.01 to 1000, got {text}")
    return fps


def transfer_to_rig(motion: "Motion", rig: str, source_rig: "Rig | None" = None) -> "RetargetedMotion":
    """The motion on the canonical joints, on a clip's skeleton in that clip's layout, or on a rig that is told; and
    what could not be kept.


    RequestError for rigs that are not known. A clip of the same skeleton stays as it is; others stand on their floor
    (see mapctl.retarget.carry).
    """
    from mapctl import retarget
    from mapctl.retarget.carry import RetargetedMotion, RiggedCharacter, retarget_motion

    if rig == "canonical":
        return RetargetedMotion(retarget.to_canonical(motion, source_rig)[0])
    body = RiggedCharacter.of(*options.read_rig_clip(rig))[1]
    carried = retarget_motion(motion, body, source_rig)
    return RetargetedMotion(body.on_rig(carried.motion), carried.notes)
