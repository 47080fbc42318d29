"""`mapctl train denoiser`: from a folder of BVH to a run folder with a checkpoint, a curve and a loadable denoiser."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mapctl.errors import MapctlError, RequestError
from priors import checkpoints
from priors.denoiser import DenoiserConfig
from priors.training import corpus as corpora
from priors.training import run_files
from priors.training.denoiser import DenoiserSettings, DenoiserTrainer, validate

Progress = Callable[[str], None]
"""Called with one line of news."""


@dataclass(frozen=True)
class DenoiserRequest:
    """What to train on, and how."""

    data: Path
    """Folder of BVH files, searched below."""
    out: Path
    """Run folder: checkpoint, curve, finished denoiser."""
    match: str = ""
    """Regular expression that a file's path below `data` must contain."""
    config: DenoiserConfig = field(default_factory=DenoiserConfig)
    """The network."""
    settings: DenoiserSettings = field(default_factory=DenoiserSettings)
    """The recipe."""
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


def train(request: DenoiserRequest, progress: Progress = lambda line: None) -> Path:
    """Train to the end of the recipe and write RUN/model.safetensors; returns its path.

    Killed and resumed, a run gives the same weights bit for bit on one machine.
    """
    _check(request)
    corpus = corpora.read(
        request.data, match=request.match, cache=request.out / "cache", skip_first=request.skip_first,
        progress=lambda done, of: progress(f"read {done} of {of} clips") if done % 200 == 0 or done == of else None,
    )  # fmt: skip
    parts = corpora.split(corpus, request.settings.seed)
    run = _Run(request, corpus.identity(), parts, progress)
    run.go()
    return run.export()


class _Run:
    """The loop and its checkpoints."""

    def __init__(self, request: DenoiserRequest, data: dict[str, str], parts: corpora.Split, progress: Progress):
        self.request, self.data, self.parts, self.progress = request, data, parts, progress
        self.trainer = DenoiserTrainer(request.config, request.settings, parts.train)
        self.curve: list[dict[str, float]] = []
        if request.resume:
            self._load()
            progress(f"resumed at step {self.trainer.step}")
        else:
            request.out.mkdir(parents=True, exist_ok=True)

    def go(self) -> None:
        """To the end of the recipe."""
        request, trainer = self.request, self.trainer
        saved = began = time.monotonic()
        news: list[dict[str, float]] = []
        while trainer.step < request.settings.steps:
            news.append(trainer.train_step())
            if not math.isfinite(news[-1]["loss"]):
                raise MapctlError(f"training diverged at step {trainer.step}; the last checkpoint is as it was")
            last = trainer.step == request.settings.steps
            if last or trainer.step % request.report_steps == 0:
                means = {name: sum(row[name] for row in news) / len(news) for name in news[0]}
                told = ", ".join(f"{name} {value:.3f}" for name, value in means.items())
                self.progress(f"step {trainer.step}: {told}, {time.monotonic() - began:.0f} s")
                news = []
            if last or trainer.step % request.validate_steps == 0:
                row = validate(trainer.network, self.parts.validation, request.settings)
                self.curve.append({"step": trainer.step, **row})
                self.progress(json.dumps(self.curve[-1]))
            if last or time.monotonic() - saved > 60 * request.checkpoint_minutes:
                self._save()
                saved = time.monotonic()

    def export(self) -> Path:
        """Write the denoiser in float16 with its card."""
        request, path = self.request, self.request.out / "model.safetensors"
        held = {"validation": list(self.parts.validation.names), "test": list(self.parts.test.names)}
        card = checkpoints.Card(
            kind="denoiser", config=request.config.as_card(), licence=request.licence,
            data={**self.data, "match": request.match, "split_seed": request.settings.seed, "held_out": held},
            training={"settings": asdict(request.settings), "curve": self.curve, "command": command(request)},
            quality={"test": validate(self.trainer.network, self.parts.test, request.settings)},
            **checkpoints.Card.of_layout(),
        )  # fmt: skip
        checkpoints.save(self.trainer.network.state_dict(), card, path)
        return path

    def _save(self) -> None:
        index = {**self._recipe(), "curve": self.curve}
        run_files.write(self.request.out, step=self.trainer.step, tensors=self.trainer.state(), index=index)

    def _load(self) -> None:
        out = self.request.out
        try:
            index, tensors = run_files.read(out)
            for part, now in self._recipe().items():
                run_files.check_same(out, part, then=index[part], now=now)
            self.curve = [dict(row) for row in index["curve"]]
            self.trainer.load_state(tensors, int(index["step"]))
        except run_files.BROKEN as error:
            raise run_files.unreadable(out, error) from error

    def _recipe(self) -> dict[str, dict]:
        """What must not change between a run's parts, as JSON gives it back."""
        settings = json.loads(json.dumps(asdict(self.request.settings)))
        return {"settings": settings, "network": self.request.config.as_card(), "data": self.data}


def command(request: DenoiserRequest) -> str:
    """What to type for the same run, for the card; options that are the defaults are left out."""
    parts = ["mapctl train denoiser --data DATA -o RUN"]
    parts += [f"--match '{request.match}'"] if request.match else []
    parts += ["--skip-first"] * request.skip_first
    if request.config.width != DenoiserConfig.width:
        parts.append(f"--width {request.config.width}")
    for name in ("steps", "batch", "window", "learning_rate", "seed"):
        if (value := getattr(request.settings, name)) != getattr(DenoiserSettings, name):
            parts.append(f"--{name.replace('_', '-')} {value:g}")
    return " ".join(parts + ["--bfloat16"] * request.settings.bfloat16)


def _check(request: DenoiserRequest) -> None:
    """Before anything is read."""
    if not request.data.is_dir():
        raise RequestError(f"{request.data} is not a folder of BVH files")
    run_files.check_begin(request.out, resume=request.resume)
