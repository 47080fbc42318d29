"""`mapctl infill`: missing frames and joints of a motion are filled in."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Infill(ModelCommand, options.RigOptions):
    """Fill in missing frames or joints of a motion; all else stays as it was. On any known rig."""

    source: options.InFile
    """A motion file."""
    out: options.OutFile
    """Where the filled motion goes."""
    gap: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="A:B")] = ()
    """Frames from A up to B (exclusive), or seconds as in 2s:4s; may be given several times. Their values are ignored.
    What is nan in IN is missing as well; where nothing is, and there are no gaps and joints, frozen and leaping frames
    are detected."""
    way: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="A:B")] = ()
    """Frames from A up to B (exclusive), or seconds, in which the place of the hips is lost and told by how the body
    moves: treadmills, drifting sensors, poses from video. May be given several times, alone or with gaps, whose poses
    are filled first; all frames may be lost so."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Only these joints are missing, canonical names or the rig's own: in the gaps, or throughout if there are none."""
    method: options.Method = "auto"
    """Method that proposes. auto: the transformer, the stitcher where hands, feet or hips are told in up to 2 s, the
    tweener, if the set of weights has one, through gaps of more than 8 s and those of more than 6 s in which the
    transformer hardly moves, or a held pose where the body stands still; a note on each gap names it. transformer,
    infiller, tweener: that network alone. stitcher: gaps of up to 2 s between whole poses from both sides, led by
    hands, feet, hips or a trajectory told in them. rollouts: a density's rollouts, wherever nothing is known. slerp:
    interpolation."""
    dna: options.MaybeDna = None
    """Motion files of any known rig, or classes that `mapctl info tweener` lists, whose style the tweener takes: in all
    gaps with --method tweener, in those of 2 s and more without parts with auto."""
    no_finish: bool = False
    """Leave the proposal as it is, on rigid bones and with exact keys: no MAP stage plants the feet."""
    curve: options.MaybeCurve = None
    """Trajectory of the hips in the gaps: a CSV or SVG file, or a shape, that passes within 1 m of where each begins
    and ends."""
    inbetweener: options.MaybeName = None
    """The file or run folder of a trained transformer, infiller or tweener; the bundled one if not given. With auto a
    tweener is for long gaps, beside the bundled transformer."""
    stitcher: options.MaybeName = None
    """The file or run folder of a trained stitcher for --method stitcher, where --inbetweener fills what it leaves, and
    for auto; the bundled one if not given."""
    path: options.MaybeName = None
    """For --way and the tweener: the file or run folder of a trained path predictor; the bundled one if not given."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. It extrapolates a gap at the end (`auto` if none is
    named), where the frames before are likely under it."""
    report: options.MaybeFile = None
    """JSON with the gaps, contacts, ledger, measures and compute."""
    video: options.MaybeFile = None
    """Film of the given motion and the filled one side by side: .mp4, .gif, .webp or .png."""
    seed: options.Count = 0
    """Seed of what rollouts sample."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds."""
    quiet: bool = False
    """No summary and no progress bar."""
