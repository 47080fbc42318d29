"""The add-on as the zip that Blender installs: the same bytes for the same source and version."""

import io
import re
import zipfile
from collections.abc import Iterator
from importlib.resources import files
from importlib.resources.abc import Traversable

from mapctl.version import __version__

_MANIFEST = "blender_manifest.toml"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # earliest date of a zip: no clock gets in
_READABLE = 0o644 << 16


def build_addon_zip() -> bytes:
    """Build the zip of the add-on: its modules, and the manifest with the version of this package."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in sorted(read_addon_files().items()):
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type, entry.external_attr, entry.create_system = zipfile.ZIP_DEFLATED, _READABLE, 3
            archive.writestr(entry, text)
    return buffer.getvalue()


def read_addon_files() -> dict[str, str]:
    """Read the files of the add-on by their names in the zip."""
    found = dict(_read_folder(files("mapctl.blender").joinpath("addon"), ""))
    return found | {_MANIFEST: re.sub(r'^version = ".*"$', f'version = "{__version__}"', found[_MANIFEST], flags=re.M)}


def _read_folder(folder: Traversable, prefix: str) -> Iterator[tuple[str, str]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _read_folder(entry, f"{prefix}{entry.name}/")
        elif entry.name.endswith((".py", ".toml")):
            yield prefix + entry.name, entry.read_text("utf-8")
