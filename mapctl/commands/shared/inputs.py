"""Readers of what options name: rigs and motions."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from controllers.common.character import Character
from mapctl import formats
from mapctl.commands.shared.options import ReadOptions
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats import smpl
from mapctl.formats.text import warn_once
from mapctl.motion import Motion
from mapctl.recording.masks import Mask, masks_from_missing
from mapctl.retarget import identify_rig, load_rig
from mapctl.retarget.character import load_standing_character, make_tpose_clip
from mapctl.retarget.doubts import assess_fit
from mapctl.retarget.rigs import Rig, parse_unit
from priors.weight_sets import note_licence

if TYPE_CHECKING:
    from mapctl.retarget.carry import RiggedCharacter
    from scenes.drawn_character import DrawnCharacter

OVERRULE = "--unit, --up and --rig overrule what was guessed"
MAX_FRAMES = 3_600_000
"""Frames of the longest motion in one call: 33 hours at the priors' rate."""


def count_frames(seconds: float) -> int:
    """Convert seconds to frames at the priors' rate; RequestError for none or too many."""
    if not seconds > 0:
        raise RequestError(f"seconds must be positive, got {seconds:g}")
    if seconds * PRIOR_FPS > MAX_FRAMES:
        raise RequestError(f"seconds must be at most {MAX_FRAMES // PRIOR_FPS}, got {seconds:g}")
    return max(2, round(seconds * PRIOR_FPS))


def read_rig(text: str | None, options: ReadOptions) -> Rig | None:
    """Read the rig of a --rig option: a preset, a TOML file, or that of a clip; with the unit and the up axis of
    `options`, which a rig without joints has where none is named. None without any of them."""
    rig = None if text is None else load_rig(text)
    if options.unit is None and options.up is None:
        return rig
    rig = rig or Rig("unlisted", {})
    return replace(rig, up=options.up or rig.up, metres_per_unit=parse_unit(options.unit) or rig.metres_per_unit)


def read_rig_clip(text: str, options: ReadOptions | None = None) -> tuple[Motion, Rig | None]:
    """Read the clip whose skeleton a --rig option names: a file, of a character standing in its rest pose; or a T-pose
    on the joints of a preset or a TOML file. Also return its rig, where it is given."""
    if formats.ending_of(text) in formats.READERS:
        rig = None if options is None else read_rig(None, options)
        clip = load_standing_character(text) or formats.load(text, metres_per_unit=rig and rig.metres_per_unit)
        if not getattr(options, "quiet", False):
            print_doubts(Path(text), clip, rig)
        return clip, rig
    rig = load_rig(text)
    return make_tpose_clip(rig), rig


def read_motion(
    path: Path,
    rig: Rig | None,
    *,
    fps: Fraction | None = None,
    body_model: Path | None = None,
    markers: Path | None = None,
    quiet: bool = False,
) -> Motion:
    """Read a motion in metres, by the rig's unit if it has one; `fps` is that of a file that does not state it, and
    `body_model` gives SMPL parameters their bones, `markers` other names of markers. Print doubts unless `quiet`."""
    unit = None if rig is None else rig.metres_per_unit
    motion = formats.load(path, fps=fps, metres_per_unit=unit, markers=markers)
    if body_model is not None:
        motion = smpl.fit_bones(motion, body_model)
    elif isinstance(motion.source, smpl.SmplLayout) and not quiet:
        warn_once(
            f"{path}: SMPL parameters have no bones and no floor: the canonical body's are taken, and the floor is put"
            " under the feet; see --smpl-model of mapctl convert"
        )
    _report_reading(path, motion, rig, quiet=quiet)
    return motion


def read_clip(path: Path, options: ReadOptions) -> tuple[Motion, Rig | None]:
    """Read a motion, and return its rig where `options` state anything of it."""
    rig = read_rig(None, options)
    return read_motion(path, rig, quiet=getattr(options, "quiet", False)), rig


def read_motion_with_gaps(
    path: Path, rig: Rig | None, *, markers: Path | None = None, quiet: bool
) -> tuple[Motion, tuple[Mask, ...], bool]:
    """Read a motion in which missing values may be NaN; also return their masks, and whether there are any."""
    unit = None if rig is None else rig.metres_per_unit
    motion, missing = formats.load_with_missing(path, metres_per_unit=unit, markers=markers)
    _report_reading(path, motion, rig, quiet=quiet)
    return motion, masks_from_missing(motion, missing), bool(missing.rotations.any() or missing.positions.any())


def _report_reading(path: Path, motion: Motion, rig: Rig | None, *, quiet: bool) -> None:
    """Note the licence of a motion that was read; print what is doubtful unless `quiet`."""
    note_licence(str(path), motion.licence)
    if quiet:
        return
    print_doubts(path, motion, rig)


def print_doubts(path: Path, motion: Motion, rig: Rig | None) -> None:
    """Print in one line on standard error what is doubtful about how a motion is understood; once for each file.

    Nothing is printed where the rig is refused, which is an error of commands that need it.
    """
    try:
        doubts = list(assess_fit(identify_rig(motion.skeleton, rig, motion=motion), motion).doubts)
    except RequestError:
        return
    if doubts:
        more = f" (and {len(doubts) - 1} more)" if len(doubts) > 1 else ""
        warn_once(f"{path}: {doubts[0].reason}{more}; {OVERRULE}, see mapctl info {path}")


def read_character(text: str, options: ReadOptions | None = None) -> Character:
    """Read the character: canonical, of a clip's skeleton, or with canonical bones on a preset's joints."""
    if text == "canonical":
        return Character()
    return as_character(read_rigged(text, options))


def read_rigged(text: str, options: ReadOptions | None = None) -> "RiggedCharacter":
    """Read the rig and stance of a clip, a preset or a rig file."""
    from mapctl.retarget.carry import RiggedCharacter

    return RiggedCharacter.of(*read_rig_clip(text, options))[1]


def as_character(body: "RiggedCharacter") -> Character:
    """Return the body of a rig as one that is moved by controllers."""
    return Character(body.leveled, float(body.stance.toe_height.mean()), body.leveled_map, body.source)


def read_drawn_character(text: str | None) -> "DrawnCharacter | None":
    """Read the character of a --character option, on which any motion can be put; None without the option.

    FileFormatError for files without one, RequestError where its joints cannot be identified.
    """
    if text is None:
        return None
    from scenes.drawn_character import DrawnCharacter

    character = DrawnCharacter.load(text)
    character.check_rig()
    return character
