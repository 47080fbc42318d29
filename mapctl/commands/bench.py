"""`mapctl bench`: cost of the solver, and the ablation of its choices, on this machine."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.tables import print_records
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError
from mapctl.runtime.progress import show_progress

if TYPE_CHECKING:
    from controllers.benchmarks.denoising import CleanClip
    from mapctl.motion import Motion
    from priors.lstm_gmm.density import LstmGmmDensity


@dataclass(frozen=True)
class Bench:
    """Cost of the solver on this machine, or the ablation of its choices."""

    what: Positional[
        Annotated[
            Literal[
                "speed",
                "ablation",
                "free-run",
                "generation",
                "steer",
                "live",
                "denoise",
                "infill",
                "tween",
                "timing",
                "gaps",
            ],
            arg(metavar="speed|ablation|free-run|generation|steer|live|denoise|infill|tween|timing|gaps"),
        ]
    ] = "speed"
    """`speed`: milliseconds a frame, fast path and reference; `ablation`: starts and unknowns compared;
    `free-run`: 8 random motions of 10,000 frames beside the training data; `generation`: raw, refined and finished
    motion beside mocap that training did not see; `steer`: random commands, which are reached and how soon; `live`: the
    same against the wall clock, for one, two and four characters at once; `denoise`: clips that training did not see,
    spoilt in several ways, beside filters tuned on the truth; `infill`: such clips with pieces taken out; `tween`: such
    clips of which keys are left, and such clips without their ends; `timing`: pairs of their poses, and the time
    between them that `mapctl tween --suggest-timing` would suggest; `gaps`: such clips without frames in their middle,
    and how far the answers are from the truth, by who gave them."""
    prior: options.MaybeName = None
    """A bundled prior, or the file or run folder of a trained one; locomotion, and locomotion-live for `steer` and
    `live`, if not given; for `denoise` as that command takes it; for `tween` auto."""
    data: options.MaybeFile = None
    """For `generation`, `denoise`, `infill`, `tween` and `timing`: the folder that was trained on, for the clips
    that were held out."""
    count: options.Count = 48
    """For `generation`: clips of 10 s to draw; for `steer`: commands to give; for `denoise`,
    `infill`, `tween` and `timing`: clips, spread over the kinds."""
    denoiser: options.Name = "denoiser"
    """For `denoise`: the bundled denoiser, or the file or run folder of a trained one."""
    infiller: options.Name = "infiller"
    """For `infill`, `tween` and `timing`, and in `denoise` for joints that are lost: the bundled infiller, or the file
    or run folder of a trained one."""
    baselines: Annotated[str, arg(metavar="RUN,RUN,...")] = ""
    """For `infill`: other trained infillers, to compare as they are."""
    refiner: options.Name = "auto"
    """For `generation`: a bundled refiner, or the file or run folder of a trained one; auto is the prior's own."""
    minutes: options.Number = 0.5
    """For `live`: how long each number of characters is steered."""
    characters: Annotated[str, arg(metavar="N,N,...")] = "1,2,4"
    """For `live`: how many at once, one number after the other."""
    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        """Measure and print."""
        use_single_thread()
        from mapctl import report

        others = {
            "denoise": self._bench_denoise,
            "infill": self._bench_infill,
            "tween": self._bench_tween,
            "timing": self._timing,
            "gaps": self._bench_gaps,
        }
        rows = others.get(self.what, self._bench_prior)()
        if self.json:
            print(report.to_json({"bench": self.what, "versions": report.package_versions(), "rows": rows}), end="")
        else:
            print_records(rows, title=f"{self.what}, one thread")
        return 0

    def _bench_prior(self) -> list[dict[str, Any]]:
        import priors
        from controllers.benchmarks import solver

        name = self.prior or ("locomotion-live" if self.what in ("steer", "live") else "locomotion")
        prior = priors.load(name)
        if self.what == "generation":
            return self._bench_generation(prior, name)
        if self.what == "steer":
            from controllers.benchmarks.steering import SteeringBenchmarkSettings, benchmark_pursuit, benchmark_steering

            return [
                *benchmark_steering(prior, SteeringBenchmarkSettings(commands=self.count)),
                *benchmark_pursuit(prior),
            ]
        if self.what == "live":
            return self._bench_live(name)
        if self.what == "speed":
            return solver.benchmark_speed(prior, prior.without_kernels())
        if self.what == "free-run":
            return solver.benchmark_free_run(prior, prior.card.quality["data"])
        return solver.benchmark_ablation(prior)

    def _bench_denoise(self) -> list[dict[str, Any]]:
        import priors
        from controllers.benchmarks.denoising import benchmark_denoising

        denoiser = priors.load_denoiser(self.denoiser)
        infiller = priors.load_infiller(self.infiller)
        clips = self._load_clips_by_kind(denoiser.card)
        densities = priors.load_choice(self.prior)
        with show_progress("denoising") as progress:
            return benchmark_denoising(clips, denoiser, infiller=infiller, densities=densities, progress=progress)

    def _bench_infill(self) -> list[dict[str, Any]]:
        import priors
        from controllers.benchmarks.infilling import benchmark_infilling, benchmark_infilling_by_kind
        from controllers.benchmarks.lost_joints import benchmark_missing_joints
        from mapctl import retarget

        infiller = priors.load_infiller(self.infiller)
        networks = {infiller.card.config["architecture"]: infiller}
        for name in filter(None, self.baselines.split(",")):
            other = priors.load_infiller(name)
            architecture = other.card.config["architecture"]
            # Two of one kind are told apart by their names.
            networks[f"{architecture} {name}" if architecture in networks else architecture] = other
        kinds: dict[str, list[Motion]] = {}
        for clip in self._load_clips_by_kind(infiller.card):
            kinds.setdefault(clip.kind, []).append(retarget.to_canonical(clip.motion)[0])
        clips = [clip for found in kinds.values() for clip in found]
        with show_progress("filling") as progress:
            rows = benchmark_infilling(clips, networks, ours=infiller.card.config["architecture"], progress=progress)
        return [*rows, *benchmark_infilling_by_kind(kinds, infiller), *benchmark_missing_joints(kinds, infiller)]

    def _bench_tween(self) -> list[dict[str, Any]]:
        from controllers.benchmarks.tweening import benchmark_tweening

        return self._bench_by_kind(benchmark_tweening)

    def _bench_gaps(self) -> list[dict[str, Any]]:
        from controllers.benchmarks.gaps import benchmark_gaps

        return self._bench_by_kind(benchmark_gaps)

    def _bench_by_kind(self, table: "Callable[..., list[dict[str, Any]]]") -> list[dict[str, Any]]:
        """A table over canonical clips by kind, of the infiller and densities."""
        import priors
        from mapctl import retarget
        from mapctl.features import PRIOR_FPS

        infiller, kinds = priors.load_infiller(self.infiller), {}
        for clip in self._load_clips_by_kind(infiller.card):
            kinds.setdefault(clip.kind, []).append(retarget.to_canonical(clip.motion)[0].resample(PRIOR_FPS))
        with show_progress(self.what) as progress:
            return table(kinds, infiller, priors.load_choice(self.prior or "auto"), progress=progress)

    def _timing(self) -> list[dict[str, Any]]:
        import priors
        from controllers.benchmarks.keyframe_timing import benchmark_keyframe_timing
        from mapctl import retarget

        clips = self._load_clips_by_kind(priors.load_infiller(self.infiller).card)
        return benchmark_keyframe_timing([retarget.to_canonical(clip.motion)[0] for clip in clips])

    def _load_clips_by_kind(self, card: Any) -> "list[CleanClip]":
        """Unseen clips, as many of each kind, without their T-poses."""
        from controllers.benchmarks.denoising import CLIP_KINDS, CleanClip, classify_clip, trim_clip
        from controllers.denoising.denoise import begins_with_tpose
        from mapctl import formats

        paths: dict[str, list[Path]] = {}
        for path in self._find_held_out(card):
            paths.setdefault(classify_clip(path.relative_to(self.data or "").as_posix()), []).append(path)
        clips = []
        for kind in CLIP_KINDS:
            for path in paths.get(kind, [])[: max(1, self.count // len(CLIP_KINDS))]:
                motion = formats.load(path)
                clips.append(CleanClip(kind, trim_clip(motion, skip_first=begins_with_tpose(motion))))
        return clips

    def _find_held_out(self, card: Any) -> list[Path]:
        """The clips that were kept from training; RequestError where they are not all there."""
        if self.data is None:
            raise RequestError(f"bench {self.what} compares with mocap: name the training data's folder with --data")
        held = card.data.get("held_out", {})
        paths = [self.data / name for part in ("validation", "test") for name in held.get(part, ())]
        if not paths or not all(path.is_file() for path in paths):
            lost = next((path for path in paths if not path.is_file()), "no clip at all")
            raise RequestError(f"{self.data} does not hold the clips kept from training: {lost}")
        return paths

    def _bench_live(self, name: str) -> list[dict[str, Any]]:
        import priors
        from controllers.benchmarks.live import benchmark_live

        if not 0 < self.minutes <= 24 * 60:
            raise RequestError(f"--minutes must be more than 0 and at most a day, got {self.minutes:g}")
        try:
            counts = [int(word) for word in self.characters.split(",")]
        except ValueError:
            counts = []
        if not counts or not all(1 <= count <= 64 for count in counts):
            raise RequestError(f"--characters must be numbers from 1 to 64, as 1,2,4; got {self.characters!r}")
        rows = []
        for count in counts:
            with show_progress(f"{count} at once") as progress:
                load = functools.partial(priors.load, name)
                rows.append(benchmark_live(load, characters=count, minutes=self.minutes, progress=progress))
        return rows

    def _bench_generation(self, prior: "LstmGmmDensity", name: str) -> list[dict[str, Any]]:
        import priors
        from controllers.benchmarks.generation import GenerationBenchmarkSettings, benchmark_generation
        from mapctl import formats, retarget
        from mapctl.features import PRIOR_FPS

        paths = self._find_held_out(prior.card)
        mocap = [retarget.to_canonical(formats.load(path))[0].resample(PRIOR_FPS) for path in paths]
        mocap = [clip for clip in mocap if clip.num_frames > PRIOR_FPS]
        return benchmark_generation(
            prior, priors.refiner_of(name, self.refiner), mocap, GenerationBenchmarkSettings(count=self.count)
        )
