"""`mapctl run`: a scripted scene."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import priors
import scenes
from controllers.common.character import Character
from mapctl import report
from mapctl.commands.run import RunScene
from mapctl.commands.shared import exit_status, options, outputs, results
from mapctl.commands.shared.character import read_character
from mapctl.commands.shared.path_walk import Walk, parse_follow, walk
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.intent.path import PathRequest
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.film import film
from scenes.scene_file import SceneDescription, load
from scenes.stage import Shot


def run(command: RunScene) -> int:
    """Check everything, let every actor walk, write the outputs.

    Ctrl-C ends the walks; those that have begun are written, without a film.
    """
    scene, curves = load(scenes.find_scene(command.scene))
    requests = [
        parse_follow(curve, actor.speed, actor.seconds) for actor, curve in zip(scene.actors, curves, strict=True)
    ]
    outputs.check_folder(command.out)
    for path in scene.films(command.out):
        outputs.require_render("av" if path.suffix.lower() == ".mp4" else "PIL")
    walks, interrupted = _walk(command, scene, requests, priors.load(scene.prior), read_character(command.rig))
    with outputs.make_folder(command.out):
        _write(command, scene, walks, films=() if interrupted else scene.films(command.out))
    if interrupted:
        return exit_status.INTERRUPTED
    return max(results.conclude(done.solution.status, strict=command.strict) for done in walks)


def _walk(
    command: RunScene,
    scene: SceneDescription,
    requests: Sequence[PathRequest],
    prior: LstmGmmDensity,
    character: Character,
) -> tuple[list[Walk], bool]:
    """Solve the walks of the first actors, of all unless Ctrl-C came, and return whether it did."""
    walks: list[Walk] = []
    for actor, request in zip(scene.actors, requests, strict=True):
        try:
            with show_progress(actor.name, quiet=command.quiet) as progress:
                walks.append(walk(prior, request, seed=actor.seed, progress=progress, character=character))
        except KeyboardInterrupt:
            if not walks:
                raise
            return walks, True
        if not command.quiet:
            print("\n".join([f"{actor.name}:", *(f"  {line}" for line in walks[-1].summary())]))
        if walks[-1].interrupted:
            return walks, True
    return walks, False


def _write(command: RunScene, scene: SceneDescription, walks: Sequence[Walk], films: Sequence[Path]) -> None:
    motions, reports = scene.motions(command.out), scene.reports(command.out)
    begun = scene.actors[: len(walks)]
    written = [*chain.from_iterable(motions[actor.name] for actor in begun), *films, *reports]
    for path in {path.parent for path in written}:
        path.mkdir(parents=True, exist_ok=True)
    outputs.check_files(written)
    for actor, done in zip(begun, walks, strict=True):
        for path in motions[actor.name]:
            done.on_rig.save(path)
    for path in reports:
        report.write_report(_report(command, scene, walks), path)
    if films:
        _film(command, scene, walks, films)
    if not command.quiet:
        print(f"wrote {', '.join(map(str, written))}")


def _film(command: RunScene, scene: SceneDescription, walks: Sequence[Walk], films: Sequence[Path]) -> None:
    shots = [
        Shot(done.solution.motion, done.request.curve, actor.colour, actor.start_seconds)
        for actor, done in zip(scene.actors, walks, strict=True)
    ]
    with show_progress("filming", quiet=command.quiet) as progress:
        film(shots, films, camera=scene.camera, size=scene.size, fps=scene.fps, progress=progress)


def _report(command: RunScene, scene: SceneDescription, walks: Sequence[Walk]) -> dict[str, Any]:
    """Build the report, by actor of each walk that has begun."""
    request = options.describe_request("run", command) | {"title": scene.title}
    actors = {
        actor.name: done.report(options.describe_request("follow", actor))
        for actor, done in zip(scene.actors, walks, strict=False)
    }
    return {"request": request, "actors": actors}
