"""Layers of a USD stage: all must lie in the file's folder or below, and be there, before they are put together."""

# The package loads its modules at run time and declares no types.
# pyright: reportAttributeAccessIssue=false

import re
from pathlib import Path

from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from mapctl.isolated.child import Refusal

_MAX_LAYERS = 1000
_REASON = re.compile(r"in file \S+ : '(.+?)'?\s*$", re.MULTILINE)
ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
"""Endings of USD files."""


def open_stage(path: str, most_bytes: int) -> Usd.Stage:
    """Open a file with all that it refers to. Refusal where it is broken, or names layers that are not there, lie
    elsewhere, or are larger than `most_bytes`."""
    root = open_layer(path)
    check_layers(root, Path(path).resolve().parent, most_bytes)
    try:
        stage = Usd.Stage.Open(root)
    except Tf.ErrorException as error:
        raise Refusal(f"cannot be put together: {first_reason(error)}") from None
    if not stage:
        raise Refusal("cannot be put together")
    return stage


def open_layer(path: str) -> Sdf.Layer:
    """Open one layer; Refusal with USD's own reason where it is broken."""
    try:
        layer = Sdf.Layer.FindOrOpen(path)
    except Tf.ErrorException as error:
        raise Refusal(f"is no sound USD file: {first_reason(error)}") from None
    if not layer:
        raise Refusal("is no sound USD file")
    return layer


def check_layers(root: Sdf.Layer, folder: Path, most_bytes: int) -> None:
    """Refuse layers that the root layer names, or those name, unless they are sound files in the folder."""
    waiting, seen = [root], {root.identifier}
    while waiting:
        layer = waiting.pop()
        for name in sorted(_named_layers(layer)):
            full = layer.ComputeAbsolutePath(name)
            if full in seen:
                continue
            seen.add(full)
            if len(seen) > _MAX_LAYERS:
                raise Refusal(f"is made of more than {_MAX_LAYERS} layers")
            _check_file(name, full, folder, most_bytes)
            if "#" not in name:
                waiting.append(open_layer(full))


def is_inside(full: str, folder: Path) -> bool:
    """Return whether a resolved asset path is a file in the folder or below, or within such a package."""
    outer = Ar.SplitPackageRelativePathOuter(full)[0]
    return "://" not in outer and Path(outer).resolve().is_relative_to(folder)


def first_reason(error: Exception) -> str:
    """Return the reason that USD's many lines of an error hold, in short."""
    found = _REASON.search(str(error))
    text = found[1] if found else str(error)
    return " ".join(text.split())[:160] or "no reason given"


def _named_layers(layer: Sdf.Layer) -> set[str]:
    """Return the layers that a layer names: those it is composed of, and those of value clips."""
    found = {name for name in layer.GetCompositionAssetDependencies() if name}
    copied = Sdf.Layer.CreateAnonymous(".usda")
    copied.TransferContent(layer)

    def note(name: str) -> str:
        if name.lower().endswith(ENDINGS):
            found.add(name)
        return name

    UsdUtils.ModifyAssetPaths(copied, note)
    return found


def _check_file(name: str, full: str, folder: Path, most_bytes: int) -> None:
    if not is_inside(full, folder):
        raise Refusal(f"names {name!r}, which is not in its folder; such files are not read")
    if "#" in name:  # the pattern of value clips, which USD looks for where it leads
        return
    outer, inner = Ar.SplitPackageRelativePathOuter(full)
    file = Path(outer)
    if not file.is_file() or (inner and not Ar.GetResolver().Resolve(full)):
        raise Refusal(f"names {name!r}, which is not there")
    if file.stat().st_size > most_bytes:
        raise Refusal(f"names {name!r}, which has {file.stat().st_size >> 20} MiB, allowed are {most_bytes >> 20}")
