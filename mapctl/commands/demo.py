"""`mapctl demo`: path following on the bundled prior, from nothing to a film."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import priors
from controllers.common.character import Character
from mapctl import report
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import INTERRUPTED, ModelCommand
from mapctl.commands.shared.outputs import show_progress
from mapctl.commands.shared.shots import PlayedShot, plan_shot, play_shot
from scenes.cameras import CameraSettings
from scenes.film import film
from scenes.scene_file import Actor


@dataclass(frozen=True)
class Demo(ModelCommand):
    """A character walks a figure-8 on the bundled prior: motion, film, contact sheet and report.

    Where the extra `render` is not installed, there is no film, and the sheet shows stick figures.
    """

    out: options.OutFolder = Path("demo-out")
    """Folder for figure8.bvh, .mp4, .png and .json; made if it does not exist."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Seed of everything random."""
    quiet: bool = False
    """No summary and no progress bar."""


CURVE, SPEED = "figure8:2", "1.2"
_SIZE = (960, 540)


def run(command: Demo) -> int:
    """Walk, write, film, report. Without OpenGL the film shows stick figures and says what is missing; what needs
    packages that are not installed is left out, and a line says so.

    Ctrl-C ends the walk; the motion so far is written, without a film.
    """
    options.check_seed(command.seed)
    outputs.check_folder(command.out)
    missing = {ending: outputs.find_missing_render(ending) for ending in ("mp4", "png")}
    actor, curve = Actor(curve=CURVE, speed=SPEED, seed=command.seed), inputs.read_curve(CURVE, None)
    plan = plan_shot(
        actor, curve, priors.load(command.prior), character=Character(), folder=Path(), options=options.ReadOptions()
    )
    with show_progress("walking", quiet=command.quiet) as progress:
        done = play_shot(plan, progress=progress)
    with outputs.make_folder(command.out) as folder:
        pictures = () if done.interrupted else (ending for ending, lacking in missing.items() if not lacking)
        files = {ending: folder / f"figure8.{ending}" for ending in ("bvh", "json", *pictures)}
        _write(command, done, files)
    if not command.quiet:
        print("\n".join([*done.summary(), f"wrote     {', '.join(map(str, files.values()))}"]))
        if any(missing.values()):
            print(f"not made  {_describe_missing(missing)}")
    return INTERRUPTED if done.interrupted else 0


def _describe_missing(missing: Mapping[str, Sequence[str]]) -> str:
    """Describe which films are left out, and what they need."""
    endings = ", ".join(f".{ending}" for ending, lacking in missing.items() if lacking)
    packages = list(dict.fromkeys(package for lacking in missing.values() for package in lacking))
    return f"{endings}: {outputs.describe_missing_render(packages)}"


def _write(command: Demo, done: PlayedShot, files: dict[str, Path]) -> None:
    outputs.save_motion(done.solution.motion, files["bvh"])
    request = options.describe_request("demo", command) | {"curve": CURVE, "speed": SPEED}
    report.write_report(done.report(request), files["json"])
    films = [files[ending] for ending in ("mp4", "png") if ending in files]
    if not films:
        return
    with show_progress("filming", quiet=command.quiet) as progress:
        actors = [(done.solution.motion, done.request.curve)]
        film(actors, films, camera=CameraSettings("fixed"), size=_SIZE, progress=progress)
