"""`mapctl demo`: path following on the bundled prior, from nothing to a film."""

from dataclasses import dataclass
from pathlib import Path

from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.path_walk import EXIT_INTERRUPTED, Walk, parse_follow, walk
from mapctl.commands.shared.threads import use_single_thread
from mapctl.runtime.progress import show_progress

CURVE, SPEED = "figure8:2", "1.2"
_SIZE = (960, 540)


@dataclass(frozen=True)
class Demo:
    """A character walks a figure-8 on the bundled prior: motion, film, contact sheet and report."""

    out: options.OutFolder = Path("demo-out")
    """Folder for figure8.bvh, .mp4, .png and .json; made if it is not there."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Of everything random."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Walk, write, film, tell. Without OpenGL the film shows stick figures and says what is missing.

        Ctrl-C ends the walk; what there is of it is written, without a film.
        """
        use_single_thread()
        options.check_seed(self.seed)
        outputs.check_folder(self.out)
        outputs.require_render("av")
        request = parse_follow(options.read_curve(CURVE, None), SPEED, None)
        import priors

        prior = priors.load(self.prior)
        with show_progress("walking", quiet=self.quiet) as progress:
            done = walk(prior, request, seed=self.seed, progress=progress)
        with outputs.make_folder(self.out) as folder:
            endings = ("bvh", "json") if done.interrupted else ("bvh", "json", "mp4", "png")
            files = {ending: folder / f"figure8.{ending}" for ending in endings}
            self._write(done, files)
        if not self.quiet:
            print("\n".join([*done.summary(), f"wrote     {', '.join(map(str, files.values()))}"]))
        return EXIT_INTERRUPTED if done.interrupted else 0

    def _write(self, done: Walk, files: dict[str, Path]) -> None:
        from mapctl import report
        from scenes.cameras import CameraSettings
        from scenes.film import film

        done.solution.motion.save(files["bvh"])
        request = options.describe_request("demo", self) | {"curve": CURVE, "speed": SPEED}
        report.write_report(done.report(request), files["json"])
        films = [files[ending] for ending in ("mp4", "png") if ending in files]
        if not films:
            return
        with show_progress("filming", quiet=self.quiet) as progress:
            actors = [(done.solution.motion, done.request.curve)]
            film(actors, films, camera=CameraSettings("fixed"), size=_SIZE, progress=progress)
