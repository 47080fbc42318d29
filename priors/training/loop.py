"""The training loop of every model: steps, validation, early stopping, checkpoints, and at the end weights and card.

A recipe (`priors.training.recipes`) is a class of settings, which are the options of `mapctl train MODEL` too, and a
trainer that takes the steps. A run folder holds `checkpoint.safetensors`, from which training resumes, `losses.csv`,
the features of the clips in `cache/`, and at the end `model.safetensors` with its card, `model.json`.
"""

import csv
import io
import json
import math
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from tyro.conf import Fixed, Suppress, arg

from mapctl.errors import CheckpointError, MapctlError, RequestError, WriteError
from mapctl.features import PRIOR_FPS
from mapctl.formats.atomic import check_folder, write_text
from mapctl.formats.text import one_line
from priors import checkpoints
from priors.checkpoints import NetworkConfig, require_at_least, write_tensors
from priors.training.data import Split, read_corpus, split_corpus
from priors.weight_sets import OF_DATA, name_for_records

CHECKPOINT, LOSSES = "checkpoint.safetensors", "losses.csv"
"""Files of a run folder."""
TRAINING, VALIDATION = "training", "validation"
"""Values of the column `part` of LOSSES: mean losses since the last report, or measures of held-out clips."""
_FIRST_LINE_SECONDS, _LINE_SECONDS = 5.0, 30.0  # to the first line on the losses, and from line to line
_WARM_UP_SHARE = 0.05  # share of the steps in which the learning rate rises
_MAX_GRADIENT_NORM = 1.0
_MOST_NAMED = 5  # files that a warning names
VALIDATED_BATCHES = 6
"""Batches whose mean losses are those of unseen clips."""
_MAY_CHANGE = (
    *("data", "out", "cuts", "level", "licence", "resume", "quiet", "patience", "steps", "device", "bfloat16", "shape"),
    *("checkpoint_minutes", "report_steps", "validate_steps"),
)  # settings that do not change what a step does

Count = Annotated[int, arg(metavar="N")]
MaybeCount = Annotated[int | None, arg(metavar="N")]
Number = Annotated[float, arg(metavar="NUMBER")]
Name = Annotated[str, arg(metavar="NAME")]
Pattern = Annotated[str | None, arg(metavar="REGEX")]
InPython = (Fixed, Suppress)
"""Annotates settings that are no options of the command line."""

Network = TypeVar("Network", bound=nn.Module)
Built = TypeVar("Built")
Row = dict[str, Any]
"""Losses of a step, or measures of held-out clips; in a curve None replaces what is not finite."""


@dataclass(frozen=True, kw_only=True)
class Settings(ABC):
    """Settings of any model. A model's class is the class of options of its command as well."""

    kind: ClassVar[str]
    """Kind of the model, in its card and on the command line."""
    used_by: ClassVar[str]
    """How commands take what was trained."""
    keeps_best: ClassVar[bool] = False
    """Whether the weights of the best validation are exported even without `patience`."""
    single_thread: ClassVar[bool] = True
    """Whether training is fastest on one thread."""

    data: Annotated[Path, arg(metavar="DIR")]
    """Folder of .bvh files, searched with everything below it."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
    """Run folder: checkpoint, losses, and at the end model.safetensors with its card."""
    match: Pattern = None
    """Only clips whose path below the data folder holds this regular expression."""
    cuts: Annotated[Path | None, arg(metavar="FILE")] = None
    """Table (CSV) of file, first and last frame: which frames are motion (`*,1,` leaves out frame 0 of all); `cmu` is
    the one for takes of CMU that comes with mapctl. Each Frame_Cuts.csv in the data folder is found by itself
    (docs/guides/data.md)."""
    level: bool = False
    """Put every clip on the canonical body and a level floor: for captures whose floor slopes or whose feet rest at
    other heights, as those of CMU."""
    steps: Count = 10_000
    """Steps in all."""
    seed: Count = 1
    """Seed of weights, windows, noise and the split of the clips."""
    patience: Count = 0
    """End training after so many validations without a better one, with the best weights; 0 takes all steps."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    licence: Annotated[str | None, arg(metavar="TEXT")] = None
    """Licence of the weights, for their card; if not given, `that of the training data`."""
    quiet: bool = False
    """Print no progress."""
    checkpoint_minutes: Annotated[float, *InPython] = 3.0
    """Between checkpoints."""
    report_steps: Annotated[int, *InPython] = 100
    """Steps of whose losses the log holds the means."""
    validate_steps: Annotated[int, *InPython] = 1000
    """Steps between two validations."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "report_steps", "validate_steps")
        require_at_least(self, 0, "patience")
        if not 0 <= self.seed < 2**63:
            raise RequestError(f"the seed must be a whole number from 0 to 2^63 - 1, got {self.seed}")

    @abstractmethod
    def make_trainer(self, parts: Split) -> "Trainer[Any]":
        """Make the trainer as it is before the first step."""

    def run(self) -> int:
        """Train as `mapctl train` does and report how the result is used; return the exit status. What ends it early
        (Ctrl-C, a full disk) states which step is saved."""
        if self.single_thread:
            torch.set_num_threads(1)
        try:
            path = train(self)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(_describe_saved(self.out)) from stop
        except WriteError as error:
            raise WriteError(f"{error}; {_describe_saved(self.out)}") from error
        self.report(f"wrote {path}; {self.used_by} {self.out}")
        return 0

    def check(self) -> None:
        """Raise RequestError for what cannot be, before anything is read."""
        if not self.data.is_dir() or not os.access(self.data, os.R_OK | os.X_OK):
            raise RequestError(f"{self.data} is not a folder that can be read")
        self.find_device()

    def find_device(self) -> str:
        """Return `cpu` or `cuda`; RequestError for one that this machine does not have."""
        asked, there = getattr(self, "device", "cpu"), torch.cuda.is_available()
        if asked == "cuda" and not there:
            raise RequestError("this machine has no CUDA device; use --device cpu")
        return "cuda" if there and asked != "cpu" else "cpu"

    @property
    def chosen(self) -> str:
        """Regular expression for the clips."""
        return self.match or ""

    @property
    def init_card(self) -> checkpoints.Card | None:
        """Card of the model with whose weights training begins, if there is one."""
        name: str | None = getattr(self, "init", None)
        return None if name is None else checkpoints.read_card(checkpoints.locate(name).with_suffix(".json"))

    @property
    def split_seed(self) -> int:
        """Seed by which clips are kept from training: that of the initial weights, where there are any, or the run
        would train on what their measures hold out."""
        return self.seed if self.init_card is None else int(self.init_card.data.get("split_seed", self.seed))

    def gather(self) -> Split:
        """Read the clips and split them; RUN/skipped.txt lists the files that were left out.

        RequestError where nothing is left, or what is left cannot be split.
        """
        corpus = read_corpus(
            self.data, match=self.chosen, cache=self.out / "cache", cuts=self.cuts, level=self.level, report=self.report
        )
        if corpus.skipped:
            reasons = [f"{self.data / name}: {reason}" for name, reason in corpus.skipped.items()]
            rest = f"; all in {self.out / 'skipped.txt'}" if len(reasons) > _MOST_NAMED else ""
            found = f"left out {len(reasons)} of {len(reasons) + len(corpus.names)} files"
            print(f"mapctl: {found}: {'; '.join(reasons[:_MOST_NAMED])}{rest}", file=sys.stderr, flush=True)
            write_text(self.out / "skipped.txt", "".join(f"{n}: {reason}\n" for n, reason in corpus.skipped.items()))
        parts = split_corpus(corpus, self.split_seed)
        held = f", without {parts.test.names[0]}, which is held out" if parts.validation is parts.test else ""
        frames = f"{len(corpus.names)} clips, {len(corpus.features)} frames"
        self.report(f"{frames}; training on {len(parts.train.names)}{held}")
        return parts

    def report(self, line: str) -> None:
        """Print a line at once, so that a log file shows how far a run of hours has come."""
        if not self.quiet:
            print(line, flush=True)


@dataclass(frozen=True, kw_only=True)
class NetworkSettings(Settings):
    """Settings of any network that is trained by one gradient, and may start from another network's weights."""

    ours: ClassVar[NetworkConfig]
    """Shape of the network unless options ask for another one."""
    papers: ClassVar[NetworkConfig | None] = None
    """Shape of the paper's network, for `paper`."""
    shape_options: ClassVar[tuple[str, ...]] = ()
    """Options that decide the shape of the network."""
    least_window: ClassVar[int] = 1
    """Frames that a window must have."""

    batch: Count = 64
    """Windows a step."""
    window: Count = 64
    """Frames a window."""
    learning_rate: Number = 1e-3
    """At its highest; less to fine-tune."""
    bfloat16: bool = False
    """Let the network compute in bfloat16: faster on a processor or GPU that has it."""
    init: Annotated[str | None, arg(metavar="NAME")] = None
    """Begin with the weights of this model, bundled or trained, and fine-tune them."""
    init_share: Number = 0.0
    """Share of the weights of --init in the ones that are written, the rest being the fine-tuned ones': 0.7 keeps most
    of what the initial model has learnt (Wortsman et al. 2022)."""
    device: Annotated[Literal["auto", "cpu", "cuda"], arg(metavar="auto|cpu|cuda")] = "auto"
    """Where to compute; auto is a GPU with CUDA where there is one."""
    shape: Annotated[NetworkConfig | None, *InPython] = None
    """Shape of the network, in place of the one that the options ask for."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 1, "batch")
        require_at_least(self, self.least_window, "window")
        if not 0 <= self.init_share < 1 or (self.init_share and self.init is None):
            raise RequestError(f"--init-share is from 0 to below 1, and needs --init; got {self.init_share:g}")
        if self.init is not None and any(getattr(self, name, None) for name in self.shape_options):
            raise RequestError("with --init the network is that model's; options of its shape do not apply")

    def find_config(self) -> Any:
        """Return the shape of the network: that of the initial model, where there is one, else what is asked for."""
        asked: Any = self.shape or (self.papers if getattr(self, "paper", False) else self.ours)
        if (card := self.init_card) is None:
            given = {name: getattr(self, name) for name in self.shape_options if name != "paper"}
            given = {name: value for name, value in given.items() if value is not None}
            return type(asked).of_card(asked.as_card() | given)
        if card.kind != self.kind:
            raise CheckpointError(f"{self.init} holds a {card.kind}, not a {self.kind}")
        return type(asked).of_card(card.config)


@dataclass
class Export:
    """Weights and facts that a finished run writes, beside those of every card."""

    tensors: Mapping[str, Tensor]  # weights, by name
    data: Row = field(default_factory=dict)  # description of its training data, for the card
    quality: Row = field(default_factory=dict)  # measures, for the card
    abilities: dict[str, float] = field(default_factory=dict)  # speeds and turning that the data show
    half: bool = True  # whether weights are kept in float16


class Trainer(ABC, Generic[Network]):
    """A network and what trains it. Everything random comes from one generator."""

    network: Network  # the network that is trained
    config: Any  # its shape, a NetworkConfig

    def __init__(self, settings: Any):
        self.settings, self.step, self.steps = settings, 0, settings.steps
        self.generator = make_generator(settings.seed)

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """Take one step; return the parts of its loss."""

    @abstractmethod
    def validate(self, corpus: Any) -> dict[str, Any]:
        """Measure the network on held-out clips."""

    @abstractmethod
    def score(self, row: Row) -> float:
        """Return the one measure of held-out clips by which models are ranked, the smaller the better; NaN without."""

    @property
    def exported(self) -> Network:
        """The network that is validated, and exported at the end."""
        return self.network

    def networks(self) -> dict[str, nn.Module]:
        """Return all that is trained, by its name in checkpoints."""
        return {"network": self.network}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Return all optimisers, by their names in checkpoints."""
        return {}

    def find_stop_reason(self, rows: Sequence[Row]) -> str | None:
        """Return why to stop after these losses since the last report, if there is a reason."""
        return None

    def identify(self) -> Row:
        """Return what must not change between a run's parts beside the settings, the network and the clips."""
        return {}

    def finish(self) -> None:
        """Change the weights once more, before they are measured and written."""

    def export(self, parts: Split) -> Export:
        """Return what is written at the end."""
        return Export(self.exported.state_dict(), quality={"test": self.validate(parts.test)})

    def state(self) -> dict[str, Tensor]:
        """Return everything that a continuation needs, but the step."""
        tensors = {"generator": self.generator.get_state()}
        for kind, network in self.networks().items():
            tensors |= {f"{kind}.{name}": value for name, value in network.state_dict().items()}
        for kind, optimiser in self.optimisers().items():
            for number, entries in optimiser.state_dict()["state"].items():
                tensors |= {f"{kind}.{number}.{key}": torch.as_tensor(value) for key, value in entries.items()}
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` returned; KeyError or RuntimeError where it is not whole."""
        if tensors["generator"].shape == self.generator.get_state().shape:
            self.generator.set_state(tensors["generator"])
        else:  # that of another kind of device
            self.generator.manual_seed(self.settings.seed + 7919 * step)
        for kind, network in self.networks().items():
            network.load_state_dict(select_prefixed(f"{kind}.", tensors))
        for kind, optimiser in self.optimisers().items():
            state: dict[int, dict[str, Tensor]] = {}
            for name, tensor in select_prefixed(f"{kind}.", tensors).items():
                number, key = name.split(".", 1)
                state.setdefault(int(number), {})[key] = tensor
            optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
        self.step = step


class GradientTrainer(Trainer[Network]):
    """One network, one loss: AdamW, unless another is made; the learning rate rises, then falls along a cosine."""

    def __init__(self, settings: Any, make: Callable[[], Network]):
        """`make` builds the network (see `draw_weights`)."""
        super().__init__(settings)
        self.network = draw_weights(make, settings.seed).to(torch.get_default_device())
        self._optimisers = self.make_optimisers()

    @property
    def progress(self) -> float:
        """Share of training that is done, by which tasks become harder; 1 where the weights began as trained ones."""
        return self.step / self.steps if self.settings.init is None else 1.0

    @abstractmethod
    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch: `loss`, and its parts in plain units."""

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Make those of the network's weights, by their names in checkpoints; all have the same learning rate."""
        return {"optimiser": make_adam(self.weights(), self.settings.learning_rate)}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return self._optimisers

    def weights(self) -> list[nn.Parameter]:
        """Return all that the loss is differentiated by."""
        return list(self.network.parameters())

    def compute_learning_rate(self) -> float:
        """Compute that of the current step."""
        return self.settings.learning_rate * warmup_cosine(self.step, self.steps)

    def score(self, row: Row) -> float:
        """Return the loss of unseen clips."""
        return row.get("loss") or math.nan

    def limit_gradients(self) -> None:
        """Clip the gradients before the optimiser's step."""
        nn.utils.clip_grad_norm_(self.weights(), _MAX_GRADIENT_NORM)

    def train_step(self) -> dict[str, float]:
        """Take one update; return the parts of its loss. MapctlError, and no update, where that is not finite."""
        optimisers = self._optimisers.values()
        for optimiser in optimisers:
            for group in optimiser.param_groups:
                group["lr"] = self.compute_learning_rate()
            optimiser.zero_grad(set_to_none=True)
        losses = self.losses()
        losses["loss"].backward()
        parts = {name: float(value.detach()) for name, value in losses.items()}
        if not math.isfinite(parts["loss"]):
            raise make_divergence_error(self.step + 1, f"the loss is {parts['loss']}")
        self.limit_gradients()
        for optimiser in optimisers:
            optimiser.step()
        self.step += 1
        return parts

    def begin(self) -> None:
        """Begin with the weights of `init`, where there is one and the run is not resumed."""
        if self.settings.init is not None and not self.settings.resume:
            self.network.load_state_dict(self.read_initial_weights())

    def read_initial_weights(self) -> dict[str, Tensor]:
        """Read the weights of `init` for this network; layers that the other lacks are as drawn."""
        tensors, own = checkpoints.load(checkpoints.locate(self.settings.init))[0], self.network.state_dict()
        return own | {name: value for name, value in tensors.items() if name in own}

    def finish(self) -> None:
        """Move the weights towards the initial ones, as far as those have a share."""
        if self.settings.init_share:
            before = self.read_initial_weights()
            for name, value in self.exported.state_dict().items():
                if value.is_floating_point():
                    value.lerp_(before[name].to(value), self.settings.init_share)


def train(settings: Settings) -> Path:
    """Train to the end, or until validation no longer improves, and write RUN/model.safetensors; return its path.

    MapctlError where training diverges; the last checkpoint then stays as it was.
    """
    settings.check()
    check_folder(settings.out)
    present = (settings.out / CHECKPOINT).exists()
    if settings.resume and not present:
        raise CheckpointError(f"{settings.out} holds no checkpoint to resume from")
    if present and not settings.resume:
        raise RequestError(f"{settings.out} already holds a run; pass --resume to continue, or choose another folder")
    with use_device(settings.find_device()):
        parts = settings.gather()
        held = parts.to(torch.get_default_device().type)
        trainer = settings.make_trainer(held)
        keeps_best = settings.keeps_best or settings.patience > 0
        # What must not change between a run's parts. The number of steps may, and the precision.
        clips = parts.whole.identity() | {"split seed": settings.split_seed} | trainer.identify()
        identity = {"settings": _list_settings(settings), "network": trainer.config.as_card(), "data": clips}
        identity = json.loads(json.dumps(identity))
        best = _copy_weights(trainer.exported) if keeps_best else {}
        curve: list[Row] = []
        if settings.resume:
            curve, kept = _load_checkpoint(settings, trainer, identity)
            best = (kept or _copy_weights(trainer.exported)) if keeps_best else {}
            settings.report(f"resumed at step {trainer.step}")
        log = Log(settings.out, trainer.step)
        losses: list[Row] = []  # since the last report
        began = saved = time.monotonic()
        first, due, stopped = trainer.step, began + _FIRST_LINE_SECONDS, None
        while True:
            last = trainer.step >= trainer.steps
            measured = curve[-1]["step"] if curve else 0
            on_time = (last or trainer.step % settings.validate_steps == 0) and trainer.step > measured
            if stopped is None and (on_time or (keeps_best and not curve)):
                row = _finite(trainer.validate(held.validation))
                log.write(trainer.step, VALIDATION, row)
                shown = ", ".join(f"{name} {'-' if v is None else f'{v:.4g}'}" for name, v in row.items())
                settings.report(f"validation at step {trainer.step}: {shown}")
                curve.append({"step": trainer.step, **row})
                scores = [math.inf if math.isnan(score) else score for score in map(trainer.score, curve)]
                if keeps_best and all(scores[-1] < before for before in scores[:-1]):
                    best = _copy_weights(trainer.exported)
                if settings.patience and len(scores) - 1 - scores.index(min(scores)) >= settings.patience:
                    stopped = f"no better in {settings.patience} validations"
            overdue = time.monotonic() - saved > 60 * settings.checkpoint_minutes
            # A run that was stopped keeps its last checkpoint: resumed from there it comes to the same end.
            if trainer.step and stopped is None and (last or overdue):
                _check_finite(trainer)
                kept = {f"best.{name}": value for name, value in best.items()}
                index = {"step": trainer.step, "identity": identity, "curve": curve}
                write_tensors(settings.out / CHECKPOINT, trainer.state() | kept, metadata={"run": json.dumps(index)})
                saved = time.monotonic()
            if last or stopped is not None:
                break
            losses.append(trainer.train_step())
            last = trainer.step >= trainer.steps
            stopped = trainer.find_stop_reason(losses)
            if last or time.monotonic() >= due:
                rate = (trainer.step - first) / max(1e-9, time.monotonic() - began)
                left = timedelta(seconds=round((trainer.steps - trainer.step) / rate))
                means = ", ".join(f"{name} {value:.3f}" for name, value in average_rows(losses).items())
                settings.report(f"step {trainer.step}/{trainer.steps}: {means}, {rate:.3g} steps/s, {left} left")
                due = time.monotonic() + _LINE_SECONDS
            if last or trainer.step % settings.report_steps == 0:
                log.write(trainer.step, TRAINING, average_rows(losses))
                losses = []
        if stopped is not None:
            settings.report(f"{stopped}: training ends with the best weights so far")
        if keeps_best:
            trainer.exported.load_state_dict(best)
        path = settings.out / "model.safetensors"
        _export(settings, trainer, parts, curve, stopped, path)
        return path


def _export(
    settings: Any, trainer: Trainer[Any], parts: Split, curve: list[Row], stopped: str | None, path: Path
) -> None:
    """Write the model with its card."""
    for network in trainer.networks().values():
        network.to("cpu")
    trainer.finish()
    exported, init = trainer.export(parts), settings.init_card
    origin = {} if init is None else {"init": {"name": name_for_records(settings.init), "licence": init.licence}}
    corpus = parts.whole
    data = {
        **corpus.identity(),
        **({"skipped": dict(corpus.skipped)} if corpus.skipped else {}),
        **({"cuts": list(corpus.cuts)} if corpus.cuts else {}),
        "match": settings.chosen,
        "split_seed": settings.split_seed,
        "held_out": {"validation": list(parts.validation.names), "test": list(parts.test.names)},
        **exported.data,
        **origin,
        "trained_on": {
            "clips": len(parts.train.names),
            "minutes": round(len(parts.train.features) / PRIOR_FPS / 60, 2),
        },
    }
    ended = {} if stopped is None else {"ended": f"step {trainer.step}: {stopped}"}
    inherited = OF_DATA if init is None else f"{OF_DATA}; {init.licence}"
    card = checkpoints.Card(
        kind=settings.kind,
        config=trainer.config.as_card(),
        licence=settings.licence or inherited,
        data=data,
        training={"settings": {"steps": settings.steps, **_list_settings(settings)}, "curve": curve, **ended},
        quality=exported.quality,
        abilities=exported.abilities,
    )
    checkpoints.save(dict(exported.tensors), card, path, half=exported.half)


def _list_settings(settings: Settings) -> Row:
    """Return the settings that change what a step does."""
    return {name: value for name, value in asdict(settings).items() if name not in _MAY_CHANGE}


def _load_checkpoint(
    settings: Settings, trainer: Trainer[Any], identity: dict[str, Row]
) -> tuple[list[Row], dict[str, Tensor]]:
    """Go on from the run folder's checkpoint; return the curve and the best weights so far."""
    with _explain_unreadable(settings.out), safe_open(settings.out / CHECKPOINT, framework="pt") as file:
        index = json.loads(file.metadata()["run"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        for part, now in identity.items():
            then = index["identity"][part]
            if changed := [f"{key}: {then.get(key)} then, {now[key]} now" for key in now if then.get(key) != now[key]]:
                raise CheckpointError(f"{settings.out}: the run was begun with other {part} ({'; '.join(changed)})")
        curve = [{**row, "step": int(row["step"])} for row in index["curve"]]
        trainer.load_state(tensors, int(index["step"]))
    if trainer.step > trainer.steps:
        raise RequestError(f"{settings.out}: {trainer.step} steps are done; --steps must be at least that")
    return curve, select_prefixed("best.", tensors)


def _describe_saved(run: Path) -> str:
    try:
        with _explain_unreadable(run), safe_open(run / CHECKPOINT, framework="pt") as file:
            step = json.loads(file.metadata()["run"])["step"]
            return f"step {step} is saved; the same command with --resume goes on"
    except CheckpointError:
        return "nothing was saved yet"


@contextmanager
def _explain_unreadable(run: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, SafetensorError) as error:
        raise CheckpointError(f"{run}: no readable checkpoint ({type(error).__name__}: {one_line(error)})") from error


class Log:
    """Mean losses and measures of held-out clips, as RUN/losses.csv."""

    def __init__(self, run: Path, step: int):
        """Rows beyond `step`, at which the run goes on, are dropped: they come again."""
        self._path, self._rows = run / LOSSES, []
        if step and self._path.exists():
            with self._path.open(encoding="utf-8", newline="") as file:
                self._rows = [row for row in csv.DictReader(file) if int(row["step"]) <= step]

    def write(self, step: int, part: str, values: Mapping[str, Any]) -> None:
        """Add a row; values that are not finite numbers are left out."""
        finite = {name: value for name, value in _finite(values).items() if value is not None}
        self._rows.append({"step": str(step), "part": part, **{name: f"{v:.9g}" for name, v in finite.items()}})
        text = io.StringIO()
        table = csv.DictWriter(
            text, list(dict.fromkeys(name for row in self._rows for name in row)), lineterminator="\n"
        )
        table.writeheader()
        table.writerows(self._rows)
        write_text(self._path, text.getvalue())


@contextmanager
def use_device(name: str) -> Iterator[None]:
    """Make tensors, networks and random numbers on this device unless another is given."""
    if torch.get_default_device().type == torch.device(name).type:
        yield  # as it is: a default of torch's costs each of its calls a little
        return
    with torch.device(name):
        yield


def make_generator(seed: int) -> torch.Generator:
    """Make a generator that draws on the device in use."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)


def make_adam(weights: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Make the usual optimiser."""
    return torch.optim.AdamW(weights, lr=learning_rate, weight_decay=1e-4)


def draw_weights(make: Callable[[], Built], seed: int) -> Built:
    """Return what `make` builds with torch's global generator, seeded, whose own numbers are left alone. It is built on
    the processor, so that it is the same whatever device it is then moved to."""
    with use_device("cpu"), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return make()


def update_average(average: nn.Module, network: nn.Module, keep: float) -> None:
    """Move a running mean of weights towards the latest ones; `keep` is the share of the past."""
    with torch.no_grad():
        for mean, weight in zip(average.parameters(), network.parameters(), strict=True):
            mean.lerp_(weight, 1 - keep)


def warmup_cosine(step: int, steps: int) -> float:
    """Return the share of the highest learning rate: rising, then along a cosine to zero."""
    rise = max(1, round(_WARM_UP_SHARE * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


def geometric_mean(values: Iterable[float | None]) -> float:
    """Geometric mean of the positive ones among them, NaN of none: a tenth less of any counts alike."""
    logs = [math.log(value) for value in values if value is not None and value > 0]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def select_prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Select those whose names begin so, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def make_divergence_error(step: int, how: str) -> MapctlError:
    """Make the error of a run whose numbers are no longer finite."""
    return MapctlError(f"training diverged at step {step}: {how}; the last checkpoint, if there is one, is kept")


def _check_finite(trainer: Trainer[Any]) -> None:
    if not all(bool(torch.isfinite(values).all()) for values in trainer.exported.parameters()):
        raise make_divergence_error(trainer.step, "its weights are not finite")


def _finite(values: Mapping[str, Any]) -> Row:
    """Replace what is not a finite number by None."""
    return {name: v if isinstance(v, int | float) and math.isfinite(v) else None for name, v in values.items()}


def average_rows(rows: Sequence[Row]) -> Row:
    """Mean of each loss over the rows that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: [float(row[name]) for row in rows if name in row] for name in names}
    return {name: sum(values) / len(values) for name, values in found.items()}


def _copy_weights(network: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}
