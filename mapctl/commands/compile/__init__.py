"""`mapctl compile`: everything that is compiled once, now."""

from dataclasses import dataclass

from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class CompileKernels(Command):
    """Compile the kernels and keep them on disk, so that the first motion does not wait for it; best after an
    installation."""

    quiet: bool = False
    """No summary and no progress bar."""
