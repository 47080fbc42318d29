"""`mapctl blender-addon`: the add-on for Blender as a zip."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from mapctl.blender.archive import build_addon_zip
from mapctl.commands.shared.command import Command
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_bytes


@dataclass(frozen=True)
class BlenderAddon(Command):
    """Write the add-on for Blender 4.2 and later, installed there by Preferences > Add-ons > Install from Disk."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE.zip")]
    """Where the zip goes."""


def run(command: BlenderAddon) -> int:
    """Build the zip and write it."""
    if command.out.suffix.lower() != ".zip":
        raise RequestError(f"{command.out}: Blender installs add-ons from .zip files; give the name that ending")
    write_bytes(command.out, build_addon_zip())
    print(f"{command.out}: install it in Blender by Edit > Preferences > Add-ons > Install from Disk")
    return 0
