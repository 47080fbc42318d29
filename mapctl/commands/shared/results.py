"""What commands that give a motion back share: checks of where it goes, and a film of it beside the given one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mapctl import __version__, formats, metrics
from mapctl import report as reports
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.metrics.comparison import make_comparable
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from scenes.plots.denoising import film_side_by_side

_SIZE = (1280, 720)


def check_destinations(out: Path, video: Path | None, *others: Path | None, given: Sequence[Path]) -> None:
    """RequestError unless the motion, its film and the other files can be written, none over a given file; leaves no
    trace.
    """
    formats.check_ending(out)
    outputs.check_files(options.collect_paths(out, video, *others), given=given)
    if video is not None:
        outputs.check_film(video, _SIZE)


def check_method(method: str, *, prior: str | None = None, infiller: str | None) -> None:
    """RequestError for a density or a network that is asked for by a method that has no use for it."""
    if prior is not None and method != "map":
        raise RequestError(f"--method {method} has no MAP stage for a density; leave --prior out")
    if infiller is not None and method in ("linear", "slerp"):
        raise RequestError(f"--method {method} knows no network; leave --infiller out")


def film_comparison(before: Motion, after: Motion, video: Path | None, *, rig: Rig | None, quiet: bool) -> None:
    """Both side by side, if a film is asked for."""
    if video is None:
        return
    with show_progress("filming", quiet=quiet) as progress:
        film_side_by_side(before, after, video, rig=rig, progress=progress)


def build_report(name: str, command: Any, motion: Motion, found: dict[str, Any]) -> dict[str, Any]:
    """The request, versions, what was found, and the motion's measures, as `mapctl measure` takes them."""
    request = {key: value for key, value in options.describe_request(name, command).items() if value is not None}
    return {
        "mapctl": __version__,
        "request": request,
        "versions": reports.package_versions(),
        **found,
        "measures": metrics.measure(make_comparable(motion, inputs.read_rig(command.rig))[0]),
    }
