"""`mapctl demo`: path following on the bundled prior, from nothing to a film."""

from dataclasses import dataclass
from pathlib import Path

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Demo(ModelCommand):
    """A character walks a figure-8 on the bundled prior: motion, film, contact sheet and report.

    Where the extra `render` is not installed, there is no film, and the sheet shows stick figures.
    """

    out: options.OutFolder = Path("demo-out")
    """Folder for figure8.bvh, .mp4, .png and .json; made if it does not exist."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Seed of everything random."""
    quiet: bool = False
    """No summary and no progress bar."""
