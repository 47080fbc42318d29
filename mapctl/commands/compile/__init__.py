"""`mapctl compile`: everything that is compiled once, now."""

from dataclasses import dataclass
from typing import ClassVar

from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class CompileKernels(ModelCommand):
    """Compile the kernels and keep them on disk, so that the first motion does not wait for it; best after an
    installation."""

    tells_licence: ClassVar[bool] = False

    quiet: bool = False
    """No summary and no progress bar."""
