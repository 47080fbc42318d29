"""`mapctl blender-addon`: the add-on for Blender as a zip."""

import io
import re
import zipfile
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared.command import Command
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_bytes
from mapctl.version import __version__

_MANIFEST = "blender_manifest.toml"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # earliest date of a zip: no clock gets in
_READABLE = 0o644 << 16


def build_addon_zip() -> bytes:
    """Build the zip of the add-on: its modules, and the manifest with the version of this package."""
    buffer = io.BytesIO()
    with as_file(files("mapctl.blender").joinpath("addon")) as folder, zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".toml")):
            text = path.read_text("utf-8")
            if path.name == _MANIFEST:
                text = re.sub(r'^version = ".*"$', f'version = "{__version__}"', text, flags=re.M)
            entry = zipfile.ZipInfo(path.relative_to(folder).as_posix(), _EPOCH)
            entry.compress_type, entry.external_attr, entry.create_system = zipfile.ZIP_DEFLATED, _READABLE, 3
            archive.writestr(entry, text)
    return buffer.getvalue()


@dataclass(frozen=True)
class BlenderAddon(Command):
    """Write the add-on for Blender 4.2 and later, installed there by Preferences > Add-ons > Install from Disk."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE.zip")]
    """Output file."""


def run(command: BlenderAddon) -> int:
    if command.out.suffix.lower() != ".zip":
        raise RequestError(f"{command.out}: Blender installs add-ons from .zip files; give the name that ending")
    write_bytes(command.out, build_addon_zip())
    print(f"{command.out}: install it in Blender by Edit > Preferences > Add-ons > Install from Disk")
    return 0
