"""`mapctl denoise`: a noisy capture is denoised, on its own rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Denoise(ModelCommand, options.RigOptions):
    """Denoise a capture with noise, sliding and gaps, of any known rig: same skeleton, names, frames and rate."""

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """A motion file, or `example:noisy-walk`, which mapctl brings along; or a folder, every motion below it."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT|FOLDER")]
    """Where the clean motion goes; of a folder, another one, which gets the same names."""
    mask: options.MaybeFile = None
    """CSV with the columns joint, start, stop: frames (from 0, stop exclusive) in which a joint of the rig is missing.
    `*` is everything, `root position` the body's position. What is nan in IN is missing too."""
    anchor: bool = False
    """Correct the trajectory so that planted feet do not travel, for captures in which the body drifts against them."""
    causal: bool = False
    """Denoise as for live capture: a frame is decided at most `--delay` after it arrives."""
    delay: options.MaybeNumber = None
    """Seconds within which --causal decides a frame, at any frame rate, but for the compute; 0.2 if not given."""
    denoiser: options.Name = "denoiser"
    """The bundled denoiser, or the file or run folder of a trained one."""
    inbetweener: options.MaybeName = None
    """The file or run folder of a trained transformer or infiller, for what is lost for 0.3 s or longer; the bundled
    transformer if not given. --causal leaves that to the denoiser."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the last stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. None if not given, which measures as well."""
    report: options.MaybeFile = None
    """JSON with the faults found, corrections, contacts, ledger; of a folder, a folder of them."""
    video: options.MaybeFile = None
    """Film of the capture and the result side by side: .mp4, .gif, .webp or .png."""
    jobs: options.Count = 1
    """For a folder: number of files at once, each in a process of its own."""
    cluster: Annotated[str | None, arg(metavar="local|ADDRESS")] = None
    """For a folder: use a ray cluster instead; `local` starts one on this machine with --jobs workers."""
    again: bool = False
    """For a folder: denoise files again whose result exists already."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: the network was out of its depth for more than half of
    the frames."""
    quiet: bool = False
    """No summary and no progress bar."""
