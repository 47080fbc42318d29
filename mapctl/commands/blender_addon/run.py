"""`mapctl blender-addon`: the add-on for Blender as a zip."""

from mapctl.blender.archive import build_addon_zip
from mapctl.commands.blender_addon import BlenderAddon
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_bytes


def run(command: BlenderAddon) -> int:
    """Build the zip and write it."""
    if command.out.suffix.lower() != ".zip":
        raise RequestError(f"{command.out}: Blender installs add-ons from .zip files; give the name that ending")
    write_bytes(command.out, build_addon_zip())
    print(f"{command.out}: install it in Blender by Edit > Preferences > Add-ons > Install from Disk")
    return 0
