"""`mapctl run`: a scripted scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from mapctl.commands.shared import character, options, outputs
from mapctl.commands.shared.path_walk import EXIT_INTERRUPTED, Walk, parse_follow, walk
from mapctl.commands.shared.threads import use_single_thread
from mapctl.runtime.progress import show_progress

if TYPE_CHECKING:
    from mapctl.intent.path import PathRequest
    from priors.lstm_gmm.density import LstmGmmDensity
    from scenes.scene_file import SceneDescription


@dataclass(frozen=True)
class RunScene:
    """A scripted scene of several actors, from a TOML file or a ready one by name."""

    scene: Positional[Annotated[str, arg(metavar="SCENE.toml")]]
    """The scene file, or the name of a scene that comes with mapctl (`mapctl info` lists them)."""
    out: options.OutFolder = Path()
    """Folder for the scene's outputs; made if it is not there."""
    rig: character.OutRig = "canonical"
    """Whose body the actors have: the canonical one, or that of a clip, on whose rig they are written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, let every actor walk, write the outputs.

        Ctrl-C ends the walks; those that have begun are written, without a film.
        """
        use_single_thread()
        import priors
        import scenes
        from scenes.scene_file import load

        scene, curves = load(scenes.find_scene(self.scene))
        requests = [
            parse_follow(curve, actor.speed, actor.seconds) for actor, curve in zip(scene.actors, curves, strict=True)
        ]
        outputs.check_folder(self.out)
        for path in scene.films(self.out):
            outputs.require_render("av" if path.suffix.lower() == ".mp4" else "PIL")
        walks, interrupted = self._walk(scene, requests, priors.load(scene.prior), character.read_character(self.rig))
        with outputs.make_folder(self.out):
            self._write(scene, walks, films=() if interrupted else scene.films(self.out))
        return EXIT_INTERRUPTED if interrupted else 0

    def _walk(
        self,
        scene: "SceneDescription",
        requests: Sequence["PathRequest"],
        prior: "LstmGmmDensity",
        person: character.Character,
    ) -> tuple[list[Walk], bool]:
        """The walks of the first actors, all of them unless Ctrl-C came, and whether it did."""
        walks: list[Walk] = []
        for actor, request in zip(scene.actors, requests, strict=True):
            try:
                with show_progress(actor.name, quiet=self.quiet) as progress:
                    walks.append(walk(prior, request, seed=actor.seed, progress=progress, person=person))
            except KeyboardInterrupt:
                if not walks:
                    raise
                return walks, True
            if not self.quiet:
                print("\n".join([f"{actor.name}:", *(f"  {line}" for line in walks[-1].summary())]))
            if walks[-1].interrupted:
                return walks, True
        return walks, False

    def _write(self, scene: "SceneDescription", walks: Sequence[Walk], films: Sequence[Path]) -> None:
        from mapctl import report

        motions, reports = scene.motions(self.out), scene.reports(self.out)
        begun = scene.actors[: len(walks)]
        written = [*chain.from_iterable(motions[actor.name] for actor in begun), *films, *reports]
        for path in {path.parent for path in written}:
            path.mkdir(parents=True, exist_ok=True)
        outputs.check_files(written)
        for actor, done in zip(begun, walks, strict=True):
            for path in motions[actor.name]:
                done.on_rig.save(path)
        for path in reports:
            report.write_report(self._report(scene, walks), path)
        if films:
            self._film(scene, walks, films)
        if not self.quiet:
            print(f"wrote {', '.join(map(str, written))}")

    def _film(self, scene: "SceneDescription", walks: Sequence[Walk], films: Sequence[Path]) -> None:
        from scenes.film import film
        from scenes.stage import Shot

        shots = [
            Shot(done.solution.motion, done.request.curve, actor.colour, actor.start_seconds)
            for actor, done in zip(scene.actors, walks, strict=True)
        ]
        with show_progress("filming", quiet=self.quiet) as progress:
            film(shots, films, camera=scene.camera, size=scene.size, fps=scene.fps, progress=progress)

    def _report(self, scene: "SceneDescription", walks: Sequence[Walk]) -> dict[str, Any]:
        """By actor, the report of each walk that has begun."""
        request = options.describe_request("run", self) | {"title": scene.title}
        actors = {
            actor.name: done.report(options.describe_request("follow", actor))
            for actor, done in zip(scene.actors, walks, strict=False)
        }
        return {"request": request, "actors": actors}
