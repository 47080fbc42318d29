"""`mapctl denoise`: a noisy capture comes back clean, on its own rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Denoise(Command):
    """A noisy, sliding, gappy capture of any known rig comes back clean: same skeleton, names, frames and rate."""

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """A motion file; or a folder, every motion below it."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT|FOLDER")]
    """Where the clean motion goes; of a folder, another one, which gets the same names."""
    rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    mask: options.MaybeFile = None
    """CSV with the columns joint, start, stop: frames (from 0, stop exclusive) in which a joint of the rig is not to be
    believed. `*` stands for everything, `root position` for where it is. What is nan in IN is not believed either."""
    sigma_deg: options.MaybeNumber = None
    """Noise of every joint's angles, degrees; told from the capture, joint by joint, if not given."""
    sigma_cm: options.MaybeNumber = None
    """Noise of the place of the hips, centimetres; told from the capture if not given."""
    anchor: bool = False
    """Let the body go where its planted feet say, for captures in which it drifts against them. The way over the
    ground changes."""
    causal: bool = False
    """As a live capture would be cleaned: a frame is decided at most `--delay` after it came."""
    delay: options.MaybeNumber = None
    """Seconds within which --causal decides a frame, at any frame rate, but for the compute; 0.2 if not given."""
    denoiser: options.Name = "denoiser"
    """The bundled denoiser, or the file or run folder of a trained one."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the last stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. None if not given, which measures as well."""
    report: options.MaybeFile = None
    """JSON with the faults found, corrections, contacts, ledger; of a folder, a folder of them."""
    plot: options.MaybeFile = None
    """PNG of joint angles before and after, and of the feet."""
    video: options.MaybeFile = None
    """Film of the capture and the result side by side: .mp4, .gif or .png."""
    jobs: options.Count = 1
    """Of a folder: how many files at once, each in a process of its own."""
    cluster: Annotated[str | None, arg(metavar="local|ADDRESS")] = None
    """Of a folder: over a ray cluster instead; `local` starts one on this machine with --jobs workers."""
    again: bool = False
    """Of a folder: do files again whose result is there already."""
    strict: bool = False
    """Exit with status 3 where not all that was asked holds: the network was out of its depth for more than half of the
    frames."""
    quiet: bool = False
    """No summary and no progress bar."""
