"""`mapctl demo`: path following on the bundled prior, from nothing to a film."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import priors
from controllers.common.character import Character
from mapctl import curves, report
from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.command import INTERRUPTED, ModelCommand
from mapctl.commands.shared.shots import plan_shot, play_shot
from mapctl.errors import RequestError
from scenes.cameras import CameraSettings
from scenes.film import film
from scenes.scene_file import Actor


@dataclass(frozen=True)
class Demo(ModelCommand):
    """A character walks a figure-8 on the bundled prior: motion, film, contact sheet and report.

    Where the extra `render` is not installed, there is no film, and the sheet shows stick figures.
    """

    out: options.OutFolder = Path("demo-out")
    """Folder for figure8.bvh, .mp4, .png and .json; created if it does not exist."""
    prior: options.Prior = "locomotion"
    seed: options.Count = 0
    """Seed of everything random."""
    quiet: options.Quiet = False


CURVE, SPEED = "figure8:2", "1.2"
_SIZE = (960, 540)


def run(command: Demo) -> int:
    """Walk, write, film, report. Without OpenGL the film shows stick figures and a note on what is missing; what needs
    packages that are not installed is left out, with a note.

    Ctrl-C ends the walk; the motion so far is written, without a film.
    """
    options.check_seed(command.seed)
    outputs.check_folder(command.out)
    missing = {}
    for ending, packages in (("mp4", ("av", "PIL")), ("png", ("PIL",))):
        try:
            outputs.require_render(*packages, "matplotlib" if find_spec("pyrender") is None else "pyrender")
        except RequestError as error:
            missing[ending] = str(error)
    actor, curve = Actor(curve=CURVE, speed=SPEED, seed=command.seed), curves.read(CURVE)
    plan = plan_shot(
        actor, curve, priors.load(command.prior), character=Character(), folder=Path(), options=options.ReadOptions()
    )
    with outputs.show_progress("walking", quiet=command.quiet) as progress:
        done = play_shot(plan, progress=progress)
    with outputs.make_folder(command.out) as folder:
        pictures = [e for e in ("mp4", "png") if e not in missing and not done.interrupted]
        files = {ending: folder / f"figure8.{ending}" for ending in ("bvh", "json", *pictures)}
        outputs.save_motion(done.solution.motion, files["bvh"])
        request = options.describe_request("demo", command) | {"curve": CURVE, "speed": SPEED}
        report.write_report(done.report(request), files["json"])
        if films := [files[ending] for ending in ("mp4", "png") if ending in files]:
            with outputs.show_progress("filming", quiet=command.quiet) as progress:
                actors = [(done.solution.motion, done.request.curve)]
                film(actors, films, camera=CameraSettings("fixed"), size=_SIZE, progress=progress)
    if not command.quiet:
        print("\n".join([*done.summary(), f"wrote     {', '.join(map(str, files.values()))}"]))
        if missing:
            print(f"missing   {', '.join(f'.{ending}' for ending in missing)}: {next(iter(missing.values()))}")
    return INTERRUPTED if done.interrupted else 0
