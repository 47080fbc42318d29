"""`mapctl train refiner`: from a density and the folder it was trained on to a run folder with a loadable refiner.

A guard watches held-out samples: the best refiner seen is kept, and training stops and restores it where one side wins.
"""

import json
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from mapctl.errors import RequestError
from mapctl.metrics.realism import RealismSettings
from priors import checkpoints
from priors.lstm_gmm import density
from priors.lstm_gmm.density import LstmGmmDensity
from priors.refiner.network import RefinerConfig
from priors.training import loop, run_files
from priors.training.corpus import Corpus
from priors.training.gathering import DataSource, Progress, describe_skipped, gather
from priors.training.recipes.refiner import PAPER, AdversarialSettings, AdversarialTrainer, RoundLosses
from priors.training.refiner_judge import RefinerEvaluator, compute_realism_gap

Row = dict[str, float | None]
"""Measures of held-out samples; None stands for what is not finite."""

_WARM_UP_FRAMES = 60  # frames of a clip that the density has seen before it is let go
_CRITIC_WON = 0.98  # share that the critic tells apart, over a report, from which it has won


@dataclass(frozen=True)
class RefinerRequest:
    """What to train on, and how."""

    data: Path
    """Folder of BVH files, searched below."""
    out: Path
    """Run folder: checkpoint, curve, finished refiner."""
    density: str = "locomotion"
    """Prior whose samples are refined."""
    match: str | None = None
    """Regular expression for the clips; the density's own if None."""
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """The network."""
    settings: AdversarialSettings = field(default_factory=AdversarialSettings)
    """The recipe."""
    samples: int = 300
    """Motions of `seconds` drawn from the density to train on."""
    seconds: float = 10.0
    """Of each."""
    judged: int = 24
    """Motions drawn to be measured, and held-out clips at least, if there are as many."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used, rather than leave the file out."""
    resume: bool = False
    """Continue from the run folder's last checkpoint."""
    checkpoint_minutes: float = 3.0
    """Between checkpoints."""
    report_rounds: int = 50
    """Between lines of news."""
    judge_rounds: int = 300
    """Between measures of held-out samples."""
    licence: str = "that of the training data"
    """Of the weights, for the card."""
    realism: RealismSettings = field(default_factory=RealismSettings)
    """How samples are told from mocap."""


def train(
    request: RefinerRequest, progress: Progress = lambda line: None, *, warn: Progress = lambda line: None
) -> Path:
    """Train to the end of the recipe, or until one side wins, and write RUN/model.safetensors; returns its path.
    `warn` is told of files that cannot be used.

    Ctrl-C and SIGTERM save a checkpoint and go on as KeyboardInterrupt. Interrupted or killed and resumed, a run gives
    the same weights bit for bit on one machine.
    """
    _check_request(request)
    prior = density.load(request.density)
    match = prior.card.data.get("match", "") if request.match is None else request.match
    seed = prior.card.data.get("split_seed", request.settings.seed)
    source = DataSource(request.data, request.out, match, strict=request.strict_data, seed=seed)
    corpus, parts = gather(source, progress=progress, warn=warn)
    generator = torch.Generator().manual_seed(request.settings.seed)
    frames = round(request.seconds * 30)
    raw = sample_corpus(prior, parts.train, request.samples, frames, generator)
    judge = RefinerEvaluator.of(
        sample_corpus(prior, parts.train, request.judged, frames, generator), parts, request.realism
    )
    trainer = AdversarialTrainer(request.config, request.settings, parts.train, raw)
    data = corpus.identity() | {"density": request.density, "match": match}
    run = _RefinerRun(request, trainer, judge, data, describe_skipped(corpus), progress)
    loop.run_to_end(run, checkpoint_minutes=request.checkpoint_minutes)
    return run.export(prior, raw)


def sample_corpus(prior: LstmGmmDensity, corpus: Corpus, count: int, frames: int, generator: torch.Generator) -> Corpus:
    """Free runs of the density, each after two seconds of a clip; clips are drawn by their length.

    So the samples have the data's own shares of gaits and speeds, and the critic is left with their quality.
    """
    clips = [clip for clip in corpus.clips() if len(clip) >= _WARM_UP_FRAMES]
    lengths = torch.tensor([float(len(clip)) for clip in clips])
    picked = torch.multinomial(lengths, count, replacement=True, generator=generator).tolist()
    state = prior.start_after(torch.stack([clips[i][0] for i in picked]))
    state = prior.advance(state, torch.stack([clips[i][1:_WARM_UP_FRAMES] for i in picked]))
    features, _ = prior.sample(state, frames, generator)
    return Corpus(tuple(f"sample {k}" for k in range(count)), (frames,) * count, features.float().flatten(0, 1))


class _RefinerRun:
    """What `loop.go` does to a trainer, its guard and its checkpoints."""

    def __init__(
        self,
        request: RefinerRequest,
        trainer: AdversarialTrainer,
        judge: RefinerEvaluator,
        data: dict[str, str],
        skipped: dict[str, dict[str, str]],
        progress: Progress,
    ):
        self.request, self.trainer, self.data, self.progress = request, trainer, data, progress
        self.evaluator, self.skipped = judge, skipped
        self.curve: list[Row] = []
        self.losses: list[RoundLosses] = []  # since the last line of news but one, where there has just been one
        self.stop_reason: str | None = None
        self.started_at = time.monotonic()
        self.best = {name: value.clone() for name, value in trainer.averaged_refiner.state_dict().items()}
        if request.resume:
            self._load()
            progress(f"resumed at round {trainer.round}")
        else:
            request.out.mkdir(parents=True, exist_ok=True)
            self.judge()

    @property
    def finished(self) -> bool:
        """At the end of the recipe, or where one side has won."""
        return self.stop_reason is not None or self.trainer.round >= self.request.settings.rounds

    @property
    def evaluation_due(self) -> bool:
        """At some lines of news and at the end of the recipe."""
        measured = bool(self.curve) and self.curve[-1]["round"] == self.trainer.round
        last = self.trainer.round >= self.request.settings.rounds
        at_last = last or (self._is_report_due and self.trainer.round % self.request.judge_rounds == 0)
        return at_last and not measured and self.stop_reason is None

    @property
    def _is_report_due(self) -> bool:
        return self.trainer.round % self.request.report_rounds == 0

    def update(self) -> None:
        """One round."""
        if self._is_report_due:
            self.losses = []
        self.losses.append(self.trainer.train_round())
        if self._is_report_due or self.trainer.round >= self.request.settings.rounds:
            self._report(time.monotonic() - self.started_at)
        self.stop_reason = self._find_stop_reason()
        if self.stop_reason is not None:
            self.progress(f"{self.stop_reason}: training ends with the best refiner seen")

    def export(self, prior: LstmGmmDensity, raw: Corpus) -> Path:
        """Write the best refiner in float16 with its card."""
        request, path = self.request, self.request.out / "model.safetensors"
        card = checkpoints.Card(
            kind="refiner",
            config=request.config.as_card(),
            licence=request.licence,
            data={
                "density": request.density,
                "density_config": prior.reference.config.as_card(),
                "samples": len(raw.lengths),
                **self.data,
                **self.skipped,
            },
            training={
                "settings": asdict(request.settings),
                "curve": self.curve,
                "command": format_refiner_command(request),
            },
            quality=min(self.curve, key=compute_realism_gap),
            **checkpoints.Card.layout_fields(),
        )
        checkpoints.save(self.best, card, path)
        return path

    def _report(self, seconds: float) -> None:
        self.progress(
            f"round {self.trainer.round}: refiner {self._mean('refiner'):.3f}, critic {self._mean('critic'):.3f} nats,"
            f" {self._mean('told'):.2f} told apart, {self.losses[-1].updates} updates, {seconds:.0f} s"
        )

    def _find_stop_reason(self) -> str | None:
        """Why to stop, if there is a reason."""
        if not self.losses[-1].finite:
            return f"training diverged at round {self.trainer.round}"
        if len(self.losses) >= self.request.report_rounds and self._mean("told") > _CRITIC_WON:
            return "the critic has won"
        return None

    def judge(self) -> None:
        """A row of the curve; the best refiner is kept."""
        row = self.evaluator(self.trainer.averaged_refiner)
        if not self.curve or compute_realism_gap(row) < min(compute_realism_gap(before) for before in self.curve):
            self.best = {name: value.clone() for name, value in self.trainer.averaged_refiner.state_dict().items()}
        row |= {"round": self.trainer.round, "score": compute_realism_gap(row)}
        row |= {f"{kind}_loss": self._mean(kind) for kind in ("refiner", "critic") if self.losses}
        self.curve.append({name: value if math.isfinite(value) else None for name, value in row.items()})
        self.progress(json.dumps(self.curve[-1]))

    def _mean(self, kind: str) -> float:
        return sum(getattr(loss, kind) for loss in self.losses) / len(self.losses)

    def save(self) -> None:
        """A checkpoint, unless training went wrong since the last: what is resumed there comes to the same end."""
        if self.stop_reason is not None:
            return
        tensors = self.trainer.state() | {f"best.{name}": value for name, value in self.best.items()}
        index = self._index() | {"losses": [asdict(loss) for loss in self.losses]}
        run_files.write_checkpoint(self.request.out, step=self.trainer.round, tensors=tensors, index=index)

    def _index(self) -> dict:
        request = self.request
        return {
            "settings": asdict(request.settings),
            "network": request.config.as_card(),
            "data": self.data,
            "curve": self.curve,
        }

    def _load(self) -> None:
        out = self.request.out
        try:
            index, tensors = run_files.read_checkpoint(out)
            for part in ("settings", "network", "data"):
                run_files.check_unchanged(out, part, then=index[part], now=self._index()[part])
            self.curve = run_files.parse_curve(index, "round")
            self.losses = [RoundLosses(**row) for row in index["losses"]]
            self.best = {name: tensors[f"best.{name}"] for name in self.best}
            self.trainer.load_state(tensors)
        except run_files.UNREADABLE_ERRORS as error:
            raise run_files.make_unreadable_error(out, error) from error


def format_refiner_command(request: RefinerRequest) -> str:
    """What to type for the same run, for the card; options that are the defaults are left out."""
    paper, wanted = request.config == PAPER[0], request.settings
    default = PAPER[1] if paper else AdversarialSettings()
    parts = [f"mapctl train refiner --data DATA -o RUN --density {request.density}"]
    parts += [f"--match '{request.match}'"] if request.match is not None else []
    for option, name in (("steps", "rounds"), ("batch", "batch"), ("window", "window"), ("seed", "seed")):
        if getattr(wanted, name) != getattr(default, name):
            parts.append(f"--{option} {getattr(wanted, name)}")
    return " ".join(parts + ["--bfloat16"] * wanted.bfloat16 + ["--paper"] * paper)


def _check_request(request: RefinerRequest) -> None:
    """Before anything is read."""
    if not request.data.is_dir():
        raise RequestError(f"{request.data} is not a folder of BVH files")
    run_files.check_run_folder(request.out, resume=request.resume)
