"""Training on windows of a corpus, whatever is learnt: from a folder of BVH to a run folder with a checkpoint, a curve
and a loadable model.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from mapctl.errors import CheckpointError, MapctlError, RequestError
from priors import checkpoints
from priors.config import NetworkConfig
from priors.training import corpus as corpora
from priors.training import loop, run_files
from priors.training.gathering import DataSource, Progress, describe_skipped, gather
from priors.training.trainer import Trainer


@runtime_checkable
class RecipeSettings(Protocol):
    """A recipe: a frozen dataclass with at least these fields."""

    @property
    def steps(self) -> int:
        """Updates."""
        ...

    @property
    def seed(self) -> int:
        """Of everything random, the split of the clips among it."""
        ...


C = TypeVar("C", bound=NetworkConfig)
S = TypeVar("S", bound=RecipeSettings)


@dataclass(frozen=True)
class WindowRequest(Generic[C, S]):
    """What to train on, and how."""

    data: Path
    """Folder of BVH files, searched below."""
    out: Path
    """Run folder: checkpoint, curve, finished model."""
    config: C
    """The network."""
    settings: S
    """The recipe."""
    match: str = ""
    """Regular expression that a file's path below `data` must contain."""
    resume: bool = False
    """Continue from the run folder's last checkpoint."""
    checkpoint_minutes: float = 3.0
    """Between checkpoints."""
    report_steps: int = 100
    """Between lines of news."""
    validate_steps: int = 1000
    """Between validations."""
    licence: str = "that of the training data"
    """Of the weights, for the card."""
    skip_first: bool = False
    """Drop frame 0 of every clip (the T-pose of CMU takes)."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used, rather than leave the file out."""
    init: str | None = None
    """Begin with the weights of this model, bundled or trained."""


@dataclass(frozen=True)
class ModelKind(Generic[C, S]):
    """What tells one model's training from another's."""

    name: str
    """Of the model, in its card and on the command line."""
    trainer: Callable[[C, S, corpora.Corpus], Trainer]
    """Begins."""
    validate: Callable[[Any, corpora.Corpus, S], dict[str, Any]]
    """Figures of a network on unseen clips."""
    shape: Callable[[C], list[str]]
    """Options of the command that the network's shape needs; those that are the defaults are left out."""


def train(
    request: WindowRequest[C, S],
    kind: ModelKind[C, S],
    progress: Progress = lambda line: None,
    *,
    warn: Progress = lambda line: None,
) -> Path:
    """Train to the end of the recipe and write RUN/model.safetensors; returns its path. `warn` is told of files that
    cannot be used.

    Ctrl-C and SIGTERM save a checkpoint and go on as KeyboardInterrupt. Interrupted or killed and resumed, a run gives
    the same weights bit for bit on one machine.
    """
    if not request.data.is_dir():
        raise RequestError(f"{request.data} is not a folder of BVH files")
    run_files.check_run_folder(request.out, resume=request.resume)
    source = DataSource(
        request.data, request.out, request.match, request.skip_first, request.strict_data, request.settings.seed
    )
    corpus, parts = gather(source, progress=progress, warn=warn)
    run = _WindowRun(request, kind, corpus, parts, progress)
    loop.run_to_end(run, checkpoint_minutes=request.checkpoint_minutes)
    return run.export()


class _WindowRun(Generic[C, S]):
    """What `loop.go` does to a trainer, its curve and its checkpoints."""

    def __init__(
        self,
        request: WindowRequest[C, S],
        kind: ModelKind[C, S],
        corpus: corpora.Corpus,
        parts: corpora.Split,
        progress: Progress,
    ):
        self.request, self.kind, self.parts, self.progress = request, kind, parts, progress
        self.data, self.skipped = corpus.identity(), describe_skipped(corpus)
        self.trainer = kind.trainer(request.config, request.settings, parts.train)
        self.curve: list[dict[str, float]] = []
        self.recent_losses: list[dict[str, float]] = []  # since the last line
        self.started_at = time.monotonic()
        if request.resume:
            self._load()
            progress(f"resumed at step {self.trainer.step}")
        else:
            request.out.mkdir(parents=True, exist_ok=True)
            if request.init is not None:
                self._load_initial_weights(request.init)

    def _load_initial_weights(self, name: str) -> None:
        """Another model's weights; CheckpointError if they are not of this network."""
        tensors, card = checkpoints.load(checkpoints.locate(name))
        if card.kind != self.kind.name or card.config != self.request.config.as_card():
            wanted = f"{self.kind.name} of {self.request.config.as_card()}"
            raise CheckpointError(f"{name} holds: {card.kind} of {card.config}; wanted: {wanted}")
        self.trainer.network.load_state_dict(tensors)

    @property
    def finished(self) -> bool:
        """At the end of the recipe."""
        return self.trainer.step >= self.request.settings.steps

    @property
    def evaluation_due(self) -> bool:
        """Every so many steps and at the end."""
        step, measured = self.trainer.step, self.curve[-1]["step"] if self.curve else 0
        return step > measured and (self.finished or step % self.request.validate_steps == 0)

    def update(self) -> None:
        """One step; MapctlError where its loss is no number."""
        trainer, news = self.trainer, self.recent_losses
        news.append(trainer.train_step())
        if not math.isfinite(news[-1]["loss"]):
            raise MapctlError(f"training diverged at step {trainer.step}; the last checkpoint is as it was")
        if self.finished or trainer.step % self.request.report_steps == 0:
            means = {name: sum(row[name] for row in news) / len(news) for name in news[0]}
            told = ", ".join(f"{name} {value:.3f}" for name, value in means.items())
            self.progress(f"step {trainer.step}: {told}, {time.monotonic() - self.started_at:.0f} s")
            news.clear()

    def judge(self) -> None:
        """A row of the curve."""
        row = self.kind.validate(self.trainer.network, self.parts.validation, self.request.settings)
        self.curve.append({"step": self.trainer.step, **row})
        self.progress(json.dumps(self.curve[-1]))

    def export(self) -> Path:
        """Write the model in float16 with its card."""
        request, path = self.request, self.request.out / "model.safetensors"
        held = {"validation": list(self.parts.validation.names), "test": list(self.parts.test.names)}
        card = checkpoints.Card(
            kind=self.kind.name,
            config=request.config.as_card(),
            licence=request.licence,
            data={
                **self.data,
                **self.skipped,
                "match": request.match,
                "split_seed": request.settings.seed,
                "held_out": held,
            },
            training={
                "settings": _settings_to_dict(request.settings),
                "curve": self.curve,
                "command": format_window_command(request, self.kind),
            },
            quality={"test": self.kind.validate(self.trainer.network, self.parts.test, request.settings)},
            **checkpoints.Card.layout_fields(),
        )
        checkpoints.save(self.trainer.network.state_dict(), card, path)
        return path

    def save(self) -> None:
        """A checkpoint."""
        index = {**self._recipe(), "curve": self.curve}
        run_files.write_checkpoint(self.request.out, step=self.trainer.step, tensors=self.trainer.state(), index=index)

    def _load(self) -> None:
        out = self.request.out
        try:
            index, tensors = run_files.read_checkpoint(out)
            for part, now in self._recipe().items():
                run_files.check_unchanged(out, part, then=index[part], now=now)
            self.curve = run_files.parse_curve(index, "step")
            self.trainer.load_state(tensors, int(index["step"]))
        except run_files.UNREADABLE_ERRORS as error:
            raise run_files.make_unreadable_error(out, error) from error

    def _recipe(self) -> dict[str, dict]:
        """What must not change between a run's parts, as JSON gives it back."""
        settings = json.loads(json.dumps(_settings_to_dict(self.request.settings)))
        return {
            "settings": settings,
            "network": self.request.config.as_card(),
            "data": self.data,
            "init": {"name": self.request.init},
        }


def format_window_command(request: WindowRequest[C, S], kind: ModelKind[C, S]) -> str:
    """What to type for the same run, for the card; options that are the defaults are left out."""
    parts = [f"mapctl train {kind.name} --data DATA -o RUN"]
    parts += [f"--match '{request.match}'"] if request.match else []
    parts += ["--skip-first"] * request.skip_first + kind.shape(request.config)
    given, usual = _settings_to_dict(request.settings), _settings_to_dict(type(request.settings)())
    for name in ("steps", "batch", "window", "learning_rate", "seed"):
        if given[name] != usual[name]:
            parts.append(f"--{name.replace('_', '-')} {given[name]:g}")
    parts += ["--init INIT"] if request.init is not None else []
    return " ".join(parts + ["--bfloat16"] * given["bfloat16"])


def _settings_to_dict(settings: Any) -> dict[str, Any]:
    """Of a recipe, which a protocol cannot tell to be a dataclass."""
    return asdict(settings)
