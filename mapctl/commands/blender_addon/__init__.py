"""`mapctl blender-addon`: the add-on for Blender as a zip."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import arg

from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class BlenderAddon(Command):
    """Write the add-on for Blender 4.2 and later, installed there by Preferences > Add-ons > Install from Disk."""

    single_thread: ClassVar[bool] = False

    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE.zip")]
    """Where the zip goes."""
