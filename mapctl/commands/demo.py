"""`mapctl demo`: path following on the bundled prior, from nothing to a film."""

from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import scenes
from mapctl.commands.run import RunScene, run_scene
from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.errors import RequestError
from scenes.scene_file import load


@dataclass(frozen=True)
class Demo(ModelCommand):
    """A character walks a figure-8 on the bundled prior: motion, film, contact sheet and report, as of the ready scene
    `figure_eight` of `mapctl run`.

    Where the extra `render` is not installed, there is no film, and the sheet shows stick figures.
    """

    out: options.OutFolder = Path("demo-out")
    """Folder for figure8.bvh, .mp4, .png and .json; created if it does not exist."""
    prior: options.Prior = "locomotion"
    seed: options.Count = 0
    """Seed of everything random."""
    quiet: options.Quiet = False


SCENE, SIZE = "figure_eight", (960, 540)


def run(command: Demo) -> int:
    """Play the scene, but for outputs that need packages that are not installed: a note names them."""
    options.check_seed(command.seed)
    path = scenes.find_scene(SCENE)
    scene, curves = load(path)
    missing = {}
    for ending, packages in ((".mp4", ("av", "PIL")), (".png", ("PIL",))):
        try:
            outputs.require_render(*packages, "matplotlib" if find_spec("pyrender") is None else "pyrender")
        except RequestError as error:
            missing[ending] = str(error)
    actors = tuple(replace(actor, seed=command.seed) for actor in scene.actors)
    kept = tuple(f"figure8{ending}" for ending in (".bvh", ".json", ".mp4", ".png") if ending not in missing)
    scene = replace(scene, actors=actors, outputs=kept, prior=command.prior, size=SIZE)
    status = run_scene(RunScene(str(path), command.out, quiet=command.quiet), path, scene, curves)
    if missing and not command.quiet:
        print(f"missing   {', '.join(missing)}: {next(iter(missing.values()))}")
    return status
