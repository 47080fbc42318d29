"""`mapctl infill`: gaps and lost joints of a motion are filled in."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Infill(Command):
    """What a motion lacks is filled in: frames, or joints; all else stays as it was. On any known rig."""

    source: options.InFile
    """A motion file."""
    out: options.OutFile
    """Where the whole motion goes."""
    gap: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="A:B")] = ()
    """Frames from A up to B (exclusive), or seconds as in 2s:4s; may be given several times. What stands in them does
    not matter. What is nan in IN is lost as well; where it is nothing, and there are no gaps and joints, frozen and
    leaping frames are looked for."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Only these joints are lost, canonical names or the rig's own: in the gaps, or throughout if there are none."""
    method: options.Method = "auto"
    """Who proposes. auto: the infiller, or a density that is rolled through gaps so long that the infiller would slide,
    or nobody where the body stands still; a note tells for every gap who. rollouts: a density, wherever nothing is
    known. slerp: interpolation."""
    no_finish: bool = False
    """Leave the proposal as it is, on rigid bones and with exact keys: no MAP stage puts the feet down."""
    curve: options.MaybeCurve = None
    """Where the hips go in the gaps: a CSV or SVG file, or a shape, that passes within 1 m of where each begins and
    ends."""
    rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    infiller: options.MaybeName = None
    """The file or run folder of a trained infiller; the bundled one if not given."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. A gap at the end is extended into by it, by `auto` if
    none is named, where it knows what comes before."""
    report: options.MaybeFile = None
    """JSON with the gaps, contacts, ledger, measures and compute."""
    video: options.MaybeFile = None
    """Film of the given motion and the whole one side by side: .mp4, .gif or .png."""
    seed: options.Count = 0
    """Seed of what rollouts draw."""
    strict: bool = False
    """Exit with status 3 where not all that was asked holds."""
    quiet: bool = False
    """No summary and no progress bar."""
