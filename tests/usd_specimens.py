"""Small sound USD files to be broken; none where usd-core is not installed."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_KINDS: tuple[dict[str, Any], ...] = (
    {"frames": 3},
    {"frames": 3, "up": "Z", "placed": "animated", "unit": 0.01, "blend_shape": True},
    {"pose": "A", "rest_pose": "bent", "placed": "moved", "frames": 2, "step": 0.8},
)


def make_usd_specimens(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Names and contents of text and binary files and packages."""
    if find_spec("pxr") is None:
        return
    from pxr import UsdUtils
    from usd_maker import make_character_usd

    for number, look in enumerate(_KINDS):
        for ending in ("usda", "usdc"):
            path = folder / f"made-{number}.{ending}"
            make_character_usd(path, **look, parts=("shoes",))
            yield path.name, path.read_bytes()
        package = folder / f"made-{number}.usdz"
        UsdUtils.CreateNewUsdzPackage(str(path), str(package))
        yield package.name, package.read_bytes()
