"""`mapctl train lstm-gmm`: from a folder of BVH to a run folder with checkpoints, a curve and a loadable prior."""

import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

from mapctl.errors import RequestError
from mapctl.features import GroundPose
from mapctl.metrics import compute_reference
from mapctl.metrics.states import summarise_states
from mapctl.pose import decode
from priors import checkpoints
from priors.config import require_at_least
from priors.lstm_gmm import density, labels
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig
from priors.training import corpus as corpora
from priors.training import loop, resume, run_files
from priors.training.free_run import measure_free_runs
from priors.training.gathering import DataSource, Progress, describe_skipped, gather
from priors.training.initial_states import measure_data_limits, select_initial_states
from priors.training.recipes.lstm_gmm import (
    DensityTrainer,
    TrainingSettings,
    compute_validation_nats,
    compute_window_nats,
)


@dataclass(frozen=True)
class DensityRequest:
    """What to train on, and how."""

    data: Path
    """Folder of BVH files, searched below."""
    out: Path
    """Run folder: checkpoint, curve, finished prior."""
    match: str = ""
    """Regular expression that a file's path below `data` must contain."""
    config: LstmGmmConfig = field(default_factory=LstmGmmConfig)
    """The network."""
    settings: TrainingSettings = field(default_factory=TrainingSettings)
    """The recipe."""
    resume: bool = False
    """Continue from the run folder's last checkpoint."""
    device: str = "auto"
    """`auto`, `cpu` or `cuda`."""
    checkpoint_minutes: float = 3.0
    """Between checkpoints."""
    report_steps: int = 100
    """Between lines of news."""
    validate_steps: int = 1000
    """Between validations with a free run."""
    starts: int = 64
    """Moments of mocap that the finished prior carries."""
    licence: str = "that of the training data"
    """Of the weights, for the card."""
    skip_first: bool = False
    """Drop frame 0 of every clip (the T-pose of CMU takes)."""
    labels: str = ""
    """Regular expression whose named groups read labels from a clip's path, which the density can then be told."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used, rather than leave the file out."""
    init: str | None = None
    """Prior whose weights and statistics training begins with; the network is then that prior's."""

    def __post_init__(self):
        require_at_least(self, 1, "starts", "report_steps", "validate_steps")


def train(
    request: DensityRequest, progress: Progress = lambda line: None, *, warn: Progress = lambda line: None
) -> Path:
    """Train to the end of the recipe and write RUN/model.safetensors; returns its path. `warn` is told of files that
    cannot be used.

    Ctrl-C and SIGTERM save a checkpoint and go on as KeyboardInterrupt. Interrupted or killed and resumed, a run gives
    the same weights bit for bit on one machine. MapctlError where training diverges; the last checkpoint then stays as
    it was.
    """
    device = _select_device(request.device)
    if not request.data.is_dir():
        raise RequestError(f"{request.data} is not a folder of BVH files")
    run_files.check_run_folder(request.out, resume=request.resume)
    source = DataSource(
        request.data, request.out, request.match, request.skip_first, request.strict_data, request.settings.seed
    )
    corpus, parts = gather(source, progress=progress, warn=warn)
    trainer = _make_trainer(request, parts.train, device)
    data = corpus.identity() | {
        "match": request.match,
        "split seed": str(request.settings.seed),
        "labels": request.labels,
        "init": request.init or "",
    }
    curve = _resume(request, trainer, data, progress)
    loop.run_to_end(
        _DensityRun(request, trainer, parts, curve, data, progress), checkpoint_minutes=request.checkpoint_minutes
    )
    return export(request, trainer, corpus, parts, curve)


def _make_trainer(request: DensityRequest, corpus: corpora.Corpus, device: str) -> DensityTrainer:
    """A new network for the corpus' labels, or the one to begin with and its own labels."""
    known = labels.read(corpus.names, request.labels)
    if request.init is None:
        return DensityTrainer(
            replace(request.config, labels=known.names), request.settings, corpus, device, labels=known
        )
    before = density.load(request.init).reference
    return DensityTrainer(
        before.config,
        request.settings,
        corpus,
        device,
        labels=known.renamed(before.config.labels),
        init=before.state_dict(),
    )


def export(
    request: DensityRequest, trainer: DensityTrainer, corpus: corpora.Corpus, parts: corpora.Split, curve: resume.Curve
) -> Path:
    """Write the model in float16 with its starts and card."""
    model = trainer.model.cpu().eval()
    found = select_initial_states(
        model, parts.train, count=request.starts, generator=torch.Generator().manual_seed(request.settings.seed)
    )
    tensors = dict(model.state_dict())
    tensors |= {
        "starts.previous": found.state.last_frame,
        "starts.hidden": found.state.hidden,
        "starts.cell": found.state.cell,
        "starts.speed": found.speed,
        "starts.weight": found.weight,
    }
    path = request.out / "model.safetensors"
    checkpoints.save(tensors, _make_card(request, model, corpus, parts, curve, found.names), path)
    return path


def _make_card(
    request: DensityRequest,
    model: LstmGmm,
    corpus: corpora.Corpus,
    parts: corpora.Split,
    curve: resume.Curve,
    starts: tuple[str, ...],
) -> checkpoints.Card:
    data = {
        "clips": len(corpus.names),
        "frames": len(corpus.features),
        **describe_skipped(corpus),
        "match": request.match,
        "labels": request.labels,
        "split_seed": request.settings.seed,
        "starts": list(starts),
        "held_out": {"validation": list(parts.validation.names), "test": list(parts.test.names)},
    }
    training = {"command": format_density_command(request), "settings": asdict(request.settings), "curve": curve}
    quality = {
        "test_nats_per_frame": compute_validation_nats(model, parts.test),
        "windows": compute_window_nats(model, (parts.validation, parts.test)),
        "mocap": _measure_mocap(parts),
        "data": summarise_states(parts.train.features),
    }
    return checkpoints.Card(
        kind="lstm-gmm",
        config=model.config.as_card(),
        licence=request.licence,
        data=data,
        training=training,
        quality=quality,
        abilities=asdict(measure_data_limits(parts.train)),
        **checkpoints.Card.layout_fields(),
    )


def format_density_command(request: DensityRequest) -> str:
    """What to type for the same run, for the card; options that are the defaults are left out."""
    plain, parts = TrainingSettings(), [f"mapctl train lstm-gmm --data DATA -o RUN --match '{request.match}'"]
    parts += [f"--labels '{request.labels}'"] if request.labels else []
    parts += [f"--init {request.init}"] if request.init else [f"--width {request.config.width}"]
    parts += ["--skip-first"] * request.skip_first + ["--bfloat16"] * request.settings.bfloat16
    wanted, default = asdict(request.settings), asdict(plain)
    for name in ("steps", "batch", "window", "learning_rate", "seed"):
        if wanted[name] != default[name]:
            parts.append(f"--{name.replace('_', '-')} {wanted[name]}")
    return " ".join(parts) + (" --paper" if request.config.retain == 0 else "")


def _measure_mocap(parts: corpora.Split) -> dict[str, dict[str, float]]:
    """What the clips kept from training show in every measure: mean, 2nd and 98th percentile (NaN left out)."""
    held = [decode(clip, GroundPose.origin()) for part in (parts.validation, parts.test) for clip in part.clips()]
    table = {name: spread._asdict() for name, spread in compute_reference(held).items()}
    return {name: row for name, row in table.items() if not math.isnan(row["mean"])}


class _DensityRun:
    """What `loop.go` does to a trainer, its curve and its checkpoints."""

    def __init__(
        self,
        request: DensityRequest,
        trainer: DensityTrainer,
        parts: corpora.Split,
        curve: resume.Curve,
        data: dict[str, str],
        progress: Progress,
    ):
        self.request, self.trainer, self.parts, self.curve = request, trainer, parts, curve
        self.data, self.progress = data, progress
        self.losses: list[float] = []  # since the last line of news
        self.started_at = time.monotonic()

    @property
    def finished(self) -> bool:
        """At the end of the recipe."""
        return self.trainer.step >= self.request.settings.steps

    @property
    def evaluation_due(self) -> bool:
        """Every so many steps and at the end."""
        step, measured = self.trainer.step, (self.curve[-1]["step"] or 0) if self.curve else 0
        return step > measured and (self.finished or step % self.request.validate_steps == 0)

    def update(self) -> None:
        """One step."""
        losses = self.losses
        losses.append(self.trainer.train_step())
        step = self.trainer.step
        if self.finished or step % self.request.report_steps == 0:
            mean, seconds = sum(losses) / len(losses), time.monotonic() - self.started_at
            self.progress(f"step {step}: {mean:.2f} nats, {seconds:.0f} s")
            losses.clear()

    def judge(self) -> None:
        """A row of the curve; MapctlError where the weights are no numbers."""
        self.trainer.check_finite()
        self.curve.append(_validate(self.trainer, self.parts))
        self.progress(json.dumps(self.curve[-1]))

    def save(self) -> None:
        """A checkpoint; MapctlError, and none, where the weights are no numbers."""
        self.trainer.check_finite()
        resume.save(self.request.out, self.trainer, self.curve, self.data)


def _validate(trainer: DensityTrainer, parts: corpora.Split) -> dict[str, float | None]:
    """Validation likelihood and the free-run health gate: likelihood does not predict stability (design, 11.2).

    None stands for what is not finite, as after a free run that exploded.
    """
    trainer.model.eval()
    row = {"step": trainer.step, "validation_nats": compute_validation_nats(trainer.model, parts.validation)}
    row |= measure_free_runs(trainer.model, parts.validation)
    trainer.model.train()
    return {name: value if math.isfinite(value) else None for name, value in row.items()}


def _resume(request: DensityRequest, trainer: DensityTrainer, data: dict[str, str], progress: Progress) -> resume.Curve:
    if not request.resume:
        request.out.mkdir(parents=True, exist_ok=True)
        return []
    curve = resume.load(request.out, trainer, data)
    progress(f"resumed at step {trainer.step}")
    return curve


def _select_device(wanted: str) -> str:
    if wanted not in ("auto", "cpu", "cuda"):
        raise RequestError(f"device must be auto, cpu or cuda, got {wanted!r}")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise RequestError("this machine has no CUDA device; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted
