"""`mapctl follow`: a character walks a drawn curve."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import character, options, outputs
from mapctl.commands.shared.path_walk import EXIT_INTERRUPTED, Walk, parse_follow, walk
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError
from mapctl.runtime.progress import show_progress

_EXIT_NOT_SATISFIED = 3
_SIZE = "1280x720"


@dataclass(frozen=True)
class FollowCurve:
    """A character walks a curve: BVH and, if asked for, a film and a report."""

    curve: Positional[options.CurveText]
    """circle:4, figure8:2, s:6, line:10, wave:1x8 (metres), a CSV file of x,z or x,y,z, or an SVG file."""
    out: options.OutFile
    """Where the motion goes: .bvh, .npz, .glb or .usda."""
    speed: options.Speed = "1.2"
    """Along the curve: a number, or 0:1.0,5:2.5 for 1 m/s at the start rising to 2.5 m/s at 5 m."""
    seconds: options.MaybeNumber = None
    """How long to walk; once along the curve if not given."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Of everything random: the same seed gives the same file."""
    rig: character.OutRig = "canonical"
    """Whose body moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    video: options.MaybeFile = None
    """Film of the walk: .mp4, .gif or .png (contact sheet)."""
    camera: Annotated[options.CameraKind | None, arg(metavar="follow|fixed|top")] = None
    """Of the film; follow if not given."""
    size: options.MaybeSize = None
    """Of the film's pictures, pixels; 1280x720 if not given."""
    report: options.MaybeFile = None
    """JSON with the request, status, ledger, measures and timing."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file; 1 for a CSV and 0.01 for an SVG if not given."""
    strict: bool = False
    """Exit with status 3 where not all that was asked holds."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, solve, write, tell. Ctrl-C ends the solve; what it has is written, without a film."""
        use_single_thread()
        self._check()
        request = parse_follow(options.read_curve(self.curve, self.metres_per_unit), self.speed, self.seconds)
        import priors

        person, prior = character.read_character(self.rig), priors.load(self.prior)
        with show_progress("walking", quiet=self.quiet) as progress:
            done = walk(prior, request, seed=self.seed, progress=progress, person=person)
        video = None if done.interrupted else self.video
        self._write(done, video)
        if not self.quiet:
            files = ", ".join(map(str, options.collect_paths(self.out, video, self.report)))
            print("\n".join([*done.summary(), f"wrote     {files}"]))
        if done.interrupted:
            return EXIT_INTERRUPTED
        return _EXIT_NOT_SATISFIED if self.strict and not done.solution.status.ok else 0

    def _check(self) -> None:
        from mapctl import formats

        options.check_seed(self.seed)
        formats.check_ending(self.out)
        outputs.check_files(options.collect_paths(self.out, self.video, self.report))
        for name in ("camera", "size"):
            if self.video is None and getattr(self, name) is not None:
                raise RequestError(f"--{name} is of the film, and --video asks for none")
        if self.video is not None:
            outputs.check_film(self.video, options.parse_size(self.size or _SIZE))

    def _write(self, done: Walk, video: Path | None) -> None:
        from mapctl import report

        done.on_rig.save(self.out)
        if self.report is not None:
            report.write_report(done.report(options.describe_request("follow", self)), self.report)
        if video is not None:
            from scenes.cameras import CameraSettings
            from scenes.film import film

            actors, camera = [(done.solution.motion, done.request.curve)], CameraSettings(self.camera or "follow")
            with show_progress("filming", quiet=self.quiet) as progress:
                size = options.parse_size(self.size or _SIZE)
                film(actors, video, camera=camera, size=size, progress=progress)
