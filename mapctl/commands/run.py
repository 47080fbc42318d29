"""`mapctl run`: a scripted scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import priors
import scenes
from controllers.common.character import Character
from mapctl import report
from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.command import INTERRUPTED, ModelCommand, conclude
from mapctl.commands.shared.inputs import read_character, read_drawn_character
from mapctl.commands.shared.outputs import show_progress
from mapctl.commands.shared.shots import (
    PlayedShot,
    ShotPlan,
    build_obstacles,
    let_others_pass,
    plan_shot,
    play_shot,
    print_notes,
    stage_actor,
)
from mapctl.curves import Curve
from mapctl.errors import FileFormatError, RequestError
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.drawn_character import DrawnCharacter
from scenes.film import film
from scenes.scene_file import Actor, SceneDescription, load


@dataclass(frozen=True)
class RunScene(ModelCommand, options.ReadOptions):
    """A scripted scene of several actors, from a TOML file or a ready one by name."""

    scene: Positional[Annotated[str, arg(metavar="SCENE.toml")]]
    """The scene file, or the name of a scene that comes with mapctl (`mapctl info` lists them)."""
    out: options.OutFolder = Path()
    """Folder for the scene's outputs; made if it does not exist."""
    rig: options.OutRig = "canonical"
    """Body of the actors whose `rig` the scene file does not give: the canonical one, or that of a clip, on whose rig
    they are written; or a rig by name or TOML file, whose joints get the canonical bones."""
    strict: bool = False
    """Exit with status 3 where not all that was asked of every actor holds."""
    quiet: bool = False
    """No summary and no progress bar."""


Drawn = Sequence[DrawnCharacter | None]
"""By actor the character that is drawn, None for a mannequin."""


def run(command: RunScene) -> int:
    """Check everything, let every actor move, write the outputs.

    Ctrl-C ends the solves; those that have begun are written, without a film.
    """
    path = Path(scenes.find_scene(command.scene))
    scene, curves = load(path)
    with priors.use_weights(command.weights or scene.weights):
        return _run_scene(command, path, scene, curves)


def _run_scene(command: RunScene, path: Path, scene: SceneDescription, curves: Sequence[Curve]) -> int:
    characters, prior = _read_characters(command, scene, path), priors.load(scene.prior)
    plans = [
        _plan(command, scene, actor, curve, prior, character, path)
        for actor, curve, character in zip(scene.actors, curves, characters, strict=True)
    ]
    drawn = _read_drawn(command, scene, path)
    outputs.check_folder(command.out)
    for film_path in scene.films(command.out):
        outputs.require_render("av" if film_path.suffix.lower() == ".mp4" else "PIL")
    walks, interrupted = _solve(command, scene, plans)
    with outputs.make_folder(command.out):
        _write(command, scene, walks, films=() if interrupted else scene.films(command.out), drawn=drawn)
    if interrupted:
        return INTERRUPTED
    return max(conclude(done.solution.status, strict=command.strict) for done in walks)


def _plan(
    command: RunScene,
    scene: SceneDescription,
    actor: Actor,
    curve: Curve,
    prior: LstmGmmDensity,
    character: Character,
    path: Path,
) -> ShotPlan:
    """Plan an actor's shot."""
    obstacles = [obstacle.build() for obstacle in scene.obstacles]
    try:
        return plan_shot(
            actor, curve, prior, character=character, folder=path.parent, options=command, obstacles=obstacles
        )
    except RequestError as error:
        raise FileFormatError(path, f"{actor.name}: {error}") from error


def _read_characters(command: RunScene, scene: SceneDescription, path: Path) -> list[Character]:
    """Read the body of each actor: on its own rig, else on that of the option."""
    own = [
        actor.rig if actor.rig is None or not Path(actor.rig).suffix else str(path.parent / actor.rig)
        for actor in scene.actors
    ]
    read = {rig: read_character(rig or command.rig, command) for rig in dict.fromkeys(own)}
    return [read[rig] for rig in own]


def _read_drawn(command: RunScene, scene: SceneDescription, path: Path) -> Drawn:
    """Read each character of the scene file once, if there is a film."""
    if not scene.films(command.out):
        return [None] * len(scene.actors)
    named = [None if actor.character is None else str(path.parent / actor.character) for actor in scene.actors]
    read = {file: read_drawn_character(file) for file in dict.fromkeys(named)}
    return [read[file] for file in named]


def _solve(command: RunScene, scene: SceneDescription, plans: Sequence[ShotPlan]) -> tuple[list[PlayedShot], bool]:
    """Solve for the first actors, for all unless Ctrl-C came, and return whether it did."""
    done: list[PlayedShot] = []
    if scene.keep_apart is not None:
        plans = let_others_pass(plans, scene.keep_apart)
    for plan in plans:
        try:
            with show_progress(plan.actor.name, quiet=command.quiet) as progress:
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
    command: RunScene, scene: SceneDescription, walks: Sequence[PlayedShot], *, films: Sequence[Path], drawn: Drawn
) -> None:
    motions, reports = scene.motions(command.out), scene.reports(command.out)
    begun = scene.actors[: len(walks)]
    written = [*chain.from_iterable(motions[actor.name] for actor in begun), *films, *reports]
    for path in {path.parent for path in written}:
        path.mkdir(parents=True, exist_ok=True)
    outputs.check_files(written)
    for actor, done in zip(begun, walks, strict=True):
        for path in motions[actor.name]:
            outputs.save_motion(done.on_rig, path)
    for path in reports:
        report.write_report(_report(command, scene, walks), path)
    if films:
        _film(command, scene, walks, films, drawn)
    if not command.quiet:
        print(f"wrote {', '.join(map(str, written))}")


def _film(
    command: RunScene, scene: SceneDescription, walks: Sequence[PlayedShot], films: Sequence[Path], drawn: Drawn
) -> None:
    shots = [
        stage_actor(done, colour=actor.colour, start_seconds=actor.start_seconds, character=character)
        for actor, done, character in zip(scene.actors, walks, drawn, strict=True)
    ]
    with show_progress("filming", quiet=command.quiet) as progress:
        props = build_obstacles(walks)
        film(shots, films, camera=scene.camera, size=scene.size, fps=scene.fps, props=props, progress=progress)
    if not command.quiet:
        print_notes(shots)


def _report(command: RunScene, scene: SceneDescription, walks: Sequence[PlayedShot]) -> dict[str, Any]:
    """Build the report, by actor of each walk that has begun."""
    request = options.describe_request("run", command) | {"title": scene.title}
    actors = {
        actor.name: done.report(options.describe_request("follow", actor))
        for actor, done in zip(scene.actors, walks, strict=False)
    }
    return outputs.add_licence({"request": request, "actors": actors})
