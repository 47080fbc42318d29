"""Choice of a painter: shaded bodies where OpenGL works, stick figures where it does not."""

import logging
import os
from typing import Literal

from mapctl.errors import RequestError
from scenes.content import Painter
from scenes.renderers import STICK_FIGURES
from scenes.renderers.offscreen import NEEDS_NO_SCREEN, NoGraphicsError, OffscreenPainter

RendererName = Literal["auto", "egl", "stick"]
RENDERER_VARIABLE = "MAPCTL_RENDERER"
"""Environment variable with the renderer where none is asked for."""

_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri libgles2"
_log = logging.getLogger("mapctl.scenes")


def select_painter(name: RendererName | None = None) -> Painter:
    """Select the painter of a name; None takes the one in MAPCTL_RENDERER, else `auto`.

    `auto` falls back to stick figures and logs one line that says what is missing; `egl` raises NoGraphicsError.
    RequestError for other names, and where not even matplotlib is installed.
    """
    wanted = name or os.environ.get(RENDERER_VARIABLE) or "auto"
    if wanted not in ("auto", "egl", "stick"):
        raise RequestError(f"the renderer must be auto, egl or stick, got {wanted!r}")
    if wanted == "stick":
        return _make_stick_painter()
    try:
        return OffscreenPainter()
    except NoGraphicsError as error:
        if wanted == "egl":
            raise
        _log.warning("%s; drawing stick figures. %s", error, _advise(error))
        return _make_stick_painter()


def back_end() -> str:
    """Describe in one line what films would be made with here, and why not better."""
    try:
        return select_painter("egl").name
    except NoGraphicsError as error:
        return f"{STICK_FIGURES}: {error}"


def _advise(error: NoGraphicsError) -> str:
    """Say what to install."""
    if isinstance(error.__cause__, ModuleNotFoundError):
        return "For shaded bodies: pip install 'mapctl[render]'"
    return f"On Debian: apt-get install {_PACKAGES}" if NEEDS_NO_SCREEN else "For shaded bodies: a screen is needed"


def _make_stick_painter() -> Painter:
    try:
        from scenes.renderers.stick_figure import StickPainter
    except ImportError as error:
        raise RequestError(f"films need matplotlib or pyrender ({error}): pip install 'mapctl[render]'") from error
    return StickPainter()
