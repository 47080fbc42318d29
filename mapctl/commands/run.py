"""`mapctl run`: a scripted scene."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import priors
import scenes
from mapctl import report
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import INTERRUPTED, ModelCommand, conclude
from mapctl.commands.shared.shots import (
    PlayedShot,
    ShotPlan,
    build_obstacles,
    let_others_pass,
    plan_shot,
    play_shot,
    stage_actor,
)
from mapctl.curves import Curve
from mapctl.errors import FileFormatError, RequestError
from scenes.drawn_character import DrawnCharacter
from scenes.film import film
from scenes.scene_file import SceneDescription, load


@dataclass(frozen=True)
class RunScene(ModelCommand, options.ReadOptions):
    """A scripted scene of several actors, from a TOML file or a ready one by name."""

    scene: Positional[Annotated[str, arg(metavar="SCENE.toml")]]
    """The scene file, or the name of a scene that comes with mapctl (`mapctl info` lists them)."""
    out: options.OutFolder = Path()
    """Folder for the scene's outputs; created if it does not exist."""
    rig: options.OutRig = "canonical"
    """Body of the actors whose `rig` the scene file does not give: the canonical one, or that of a clip, on whose rig
    they are written; or a rig by name or TOML file, whose joints get the canonical bones."""
    variations: options.Count = 1
    """Number of takes, each with the next seeds; their files are numbered: walk_000.bvh, walk_001.bvh, ..."""
    strict: bool = False
    """Exit with status 3 where not all that was asked of every actor holds."""
    quiet: options.Quiet = False


def run(command: RunScene) -> int:
    """Check everything, let every actor move, write the outputs.

    Ctrl-C ends the solves; those that have begun are written, without a film.
    """
    path = Path(scenes.find_scene(command.scene))
    scene, curves = load(path)
    options.check_variations(command.variations)
    takes = [scene] if command.variations == 1 else [_number(scene, take) for take in range(command.variations)]
    with priors.use_weights(command.weights or scene.weights):
        return max(run_scene(command, path, take, curves) for take in takes)


def _number(scene: SceneDescription, take: int) -> SceneDescription:
    actors = tuple(replace(actor, seed=actor.seed + take) for actor in scene.actors)
    names = tuple(str(outputs.number_path(Path(name), take)) for name in scene.outputs)
    return replace(scene, actors=actors, outputs=names)


def run_scene(command: RunScene, path: Path, scene: SceneDescription, curves: Sequence[Curve]) -> int:
    """Plan and solve every actor of a scene from a file, along its curve, and write the outputs; return the exit
    status."""
    read_body, read_drawn = functools.cache(inputs.read_character), functools.cache(inputs.read_drawn_character)
    prior, plans = priors.load(scene.prior), list[ShotPlan]()
    for actor, curve in zip(scene.actors, curves, strict=True):
        rig = actor.rig and (str(path.parent / actor.rig) if Path(actor.rig).suffix else actor.rig)
        character = read_body(rig or command.rig, command)
        try:
            plans.append(
                plan_shot(
                    actor,
                    curve,
                    prior,
                    character=character,
                    folder=path.parent,
                    options=command,
                    obstacles=scene.obstacles,
                    ground=scene.ground,
                )
            )
        except RequestError as error:
            raise FileFormatError(path, f"{actor.name}: {error}") from error
    films = scene.films(command.out)
    drawn = [read_drawn(str(path.parent / a.character) if a.character and films else None) for a in scene.actors]
    outputs.check_folder(command.out)
    for film_path in films:
        outputs.require_render("av" if film_path.suffix.lower() == ".mp4" else "PIL")
    walks, interrupted = _solve(command, scene, plans)
    with outputs.make_folder(command.out):
        _write(command, scene, walks, films=() if interrupted else films, drawn=drawn)
    if interrupted:
        return INTERRUPTED
    return max(conclude(done.solution.status, strict=command.strict) for done in walks)


def _solve(command: RunScene, scene: SceneDescription, plans: Sequence[ShotPlan]) -> tuple[list[PlayedShot], bool]:
    """Solve for the first actors, for all unless Ctrl-C came, and return whether it did."""
    done: list[PlayedShot] = []
    if scene.keep_apart is not None:
        plans = let_others_pass(plans, scene.keep_apart)
    for plan in plans:
        try:
            with outputs.show_progress(plan.actor.name, quiet=command.quiet) as progress:
                done.append(play_shot(plan, done, keep_apart=scene.keep_apart, progress=progress))
        except KeyboardInterrupt:
            if not done:
                raise
            return done, True
        if not command.quiet:
            print("\n".join([f"{plan.actor.name}:", *(f"  {line}" for line in done[-1].summary())]))
        if done[-1].interrupted:
            return done, True
    return done, False


def _write(
    command: RunScene,
    scene: SceneDescription,
    walks: Sequence[PlayedShot],
    *,
    films: Sequence[Path],
    drawn: Sequence[DrawnCharacter | None],
) -> None:
    motions, reports = scene.motions(command.out), scene.reports(command.out)
    begun = scene.actors[: len(walks)]
    written = [*chain.from_iterable(motions[actor.name] for actor in begun), *films, *reports]
    outputs.check_files(written)
    for actor, done in zip(begun, walks, strict=True):
        for path in motions[actor.name]:
            outputs.save_motion(done.on_rig, path)
    request = options.describe_request("run", command) | {"title": scene.title}
    actors = {
        actor.name: done.report(options.describe_request("follow", actor))
        for actor, done in zip(begun, walks, strict=True)
    }
    for path in reports:
        report.write_report(outputs.add_licence({"request": request, "actors": actors}), path)
    if films:
        shots = [
            stage_actor(done, colour=actor.colour, start_seconds=actor.start_seconds, character=character)
            for actor, done, character in zip(scene.actors, walks, drawn, strict=True)
        ]
        with outputs.show_progress("filming", quiet=command.quiet) as progress:
            film(
                shots,
                films,
                camera=scene.camera,
                size=scene.size,
                fps=scene.fps,
                props=build_obstacles(walks),
                ground=scene.ground,
                progress=progress,
            )
        notes = dict.fromkeys(note for shot in shots if shot.drawn is not None for note in shot.drawn.notes)
        if not command.quiet:
            print("".join(f"note      the character that is drawn: {note}\n" for note in notes), end="")
    if not command.quiet:
        print(f"wrote {', '.join(map(str, written))}")
