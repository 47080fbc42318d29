"""`mapctl bench`: cost of the solver, and the ablation of its choices, on this machine."""

import functools
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from mapctl.commands import options
from mapctl.commands.tables import print_records
from mapctl.commands.threads import compute_on_one
from mapctl.errors import RequestError
from mapctl.progress import bar


@dataclass(frozen=True)
class Bench:
    """Cost of the solver on this machine, or the ablation of its choices."""

    what: Positional[
        Annotated[
            Literal["speed", "ablation", "free-run", "generation", "steer", "live"],
            arg(metavar="speed|ablation|free-run|generation|steer|live"),
        ]
    ] = "speed"
    """`speed`: milliseconds a frame, fast path and reference; `ablation`: starts and unknowns compared;
    `free-run`: 8 random motions of 10,000 frames beside the training data; `generation`: raw, refined and finished
    motion beside mocap that training did not see; `steer`: random commands, which are reached and how soon; `live`: the
    same against the wall clock, for one, two and four characters at once."""
    prior: options.MaybeName = None
    """A bundled prior, or the file or run folder of a trained one; locomotion, and locomotion-live for `steer` and
    `live`, if not given."""
    data: options.MaybeFile = None
    """For `generation`: the folder that the prior was trained on; its held-out clips are looked up there."""
    count: options.Count = 48
    """For `generation`: clips of 10 s to draw; for `steer`: commands to give."""
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
        compute_on_one()
        import priors
        from controllers import bench
        from mapctl import report

        name = self.prior or ("locomotion-live" if self.what in ("steer", "live") else "locomotion")
        prior = priors.load(name)
        if self.what == "generation":
            rows = self._generation(prior, name)
        elif self.what == "steer":
            from controllers.bench_steer import SteeringSettings, pursued, steering

            rows = [*steering(prior, SteeringSettings(commands=self.count)), *pursued(prior)]
        elif self.what == "live":
            rows = self._live(name)
        else:
            rows = {"speed": bench.speed, "ablation": bench.ablation, "free-run": bench.free_run}[self.what](prior)
        if self.json:
            print(report.as_json({"bench": self.what, "versions": report.versions(), "rows": rows}), end="")
        else:
            print_records(rows, title=f"{self.what}, one thread")
        return 0

    def _live(self, name: str) -> list[dict[str, Any]]:
        import priors
        from controllers.bench_live import live

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
            with bar(f"{count} at once") as progress:
                load = functools.partial(priors.load, name)
                rows.append(live(load, characters=count, minutes=self.minutes, progress=progress))
        return rows

    def _generation(self, prior: Any, name: str) -> list[dict[str, Any]]:
        import priors
        from controllers.bench_generation import GenerationSettings, generation
        from mapctl import formats, retarget
        from mapctl.features import PRIOR_FPS

        if self.data is None:
            raise RequestError("bench generation compares with mocap: name the training data's folder with --data")
        held = prior.card.data.get("held_out", {})
        paths = [self.data / name for part in ("validation", "test") for name in held.get(part, ())]
        if not paths or not all(path.is_file() for path in paths):
            lost = next((path for path in paths if not path.is_file()), "no clip at all")
            raise RequestError(f"{self.data} does not hold the clips kept from training: {lost}")
        mocap = [retarget.to_canonical(formats.load(path))[0].resample(PRIOR_FPS) for path in paths]
        mocap = [clip for clip in mocap if clip.num_frames > PRIOR_FPS]
        return generation(prior, priors.refiner_of(name, self.refiner), mocap, GenerationSettings(count=self.count))
