"""The training loop of every model: steps, validations, early stopping, checkpoints, and at the end weights and card.

A model's recipe says what it is trained on, and its trainer takes the steps. A run folder holds
`checkpoint.safetensors`, from which training resumes, `losses.csv` and `tensorboard/`, the features of the clips in
`cache/`, and at the end `model.safetensors` with its card, `model.json`.

Inside `use_device` a GPU is torch's default device, so that windows, networks and random numbers are made there.
"""

import csv
import io
import json
import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from mapctl.errors import CheckpointError, MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats.atomic import check_folder, write_text
from mapctl.formats.text import one_line
from priors import checkpoints
from priors.checkpoints import NetworkConfig, require_at_least, write_tensors
from priors.training.data import Corpus, Split, read_corpus, split_corpus
from priors.weight_sets import OF_DATA, name_for_records


@contextmanager
def use_device(name: str) -> Iterator[None]:
    """Make tensors on this device unless another is given."""
    if torch.get_default_device().type == torch.device(name).type:
        yield  # as it is: a default of torch's costs each of its calls a little
        return
    with torch.device(name):
        yield


def make_generator(seed: int) -> torch.Generator:
    """Make a generator that draws on the device in use."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)


Network = TypeVar("Network", bound=nn.Module)
Drawn = TypeVar("Drawn")
_WARM_UP_SHARE = 0.05  # share of the steps in which the learning rate rises
_MAX_GRADIENT_NORM = 1.0


class Trainer(ABC, Generic[Network]):
    """A network and what trains it. Everything random comes from one generator."""

    network: Network
    """The network that is trained."""

    def __init__(self, *, steps: int, seed: int):
        self.step, self.steps, self.seed = 0, steps, seed
        self.generator = make_generator(seed)

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """Take one step; return the parts of its loss."""

    @abstractmethod
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the network on held-out clips."""

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

    def check_finite(self) -> None:
        """Raise MapctlError unless every weight is finite."""
        if not all(bool(torch.isfinite(values).all()) for values in self.exported.parameters()):
            raise make_divergence_error(self.step, "its weights are not finite")

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
            self.generator.manual_seed(self.seed + step)
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

    def __init__(self, make: Callable[[], Network], settings: Any):
        """`make` builds the network (see `draw_weights`); settings have steps, a learning rate and a seed."""
        super().__init__(steps=settings.steps, seed=settings.seed)
        self.settings, self.learning_rate, self.grown = settings, settings.learning_rate, False
        self.network = draw_weights(make, settings.seed).to(torch.get_default_device())
        self._optimisers = self.make_optimisers()

    @property
    def progress(self) -> float:
        """Share of training that is done, by which tasks become harder; 1 where the weights began as trained ones."""
        return 1.0 if self.grown else self.step / self.steps

    @abstractmethod
    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch: `loss`, and its parts in plain units."""

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Make those of the network's weights, by their names in checkpoints; all have the same learning rate."""
        return {"optimiser": make_adam(self.weights(), self.learning_rate)}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Return all optimisers, by their names in checkpoints."""
        return self._optimisers

    def weights(self) -> list[nn.Parameter]:
        """Return all that the loss is differentiated by."""
        return list(self.network.parameters())

    def compute_learning_rate(self) -> float:
        """Compute that of the current step."""
        return self.learning_rate * warmup_cosine(self.step, self.steps)

    def limit_gradients(self) -> None:
        """Clip the gradients before the optimiser's step."""
        nn.utils.clip_grad_norm_(self.weights(), _MAX_GRADIENT_NORM)

    def train_step(self) -> dict[str, float]:
        """Take one update; return the parts of its loss. MapctlError, and no update, where that is not finite."""
        optimisers = self._optimisers.values()
        for group in [group for optimiser in optimisers for group in optimiser.param_groups]:
            group["lr"] = self.compute_learning_rate()
        for optimiser in optimisers:
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


def make_adam(weights: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Make the usual optimiser."""
    return torch.optim.AdamW(weights, lr=learning_rate, weight_decay=1e-4)


def draw_weights(make: Callable[[], Drawn], seed: int) -> Drawn:
    """Return what `make` builds with torch's global generator, seeded, whose own numbers are left alone. It is made on
    the processor, so that it is the same whatever device it is then moved to."""
    with use_device("cpu"), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return make()


def make_divergence_error(step: int, how: str) -> MapctlError:
    """Make the error of a run whose numbers are no longer finite."""
    return MapctlError(f"training diverged at step {step}: {how}; the last checkpoint, if there is one, is kept")


def warmup_cosine(step: int, steps: int) -> float:
    """Return the share of the highest learning rate: rising, then along a cosine to zero."""
    rise = max(1, round(_WARM_UP_SHARE * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


def select_prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Select those whose names begin so, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


class HistoryBuffer:
    """Windows that earlier weights made, so that the critic does not forget faults that it once knew."""

    def __init__(self, windows: Float[Tensor, "size frames features"]):
        self.windows = windows.clone()

    def mix(self, fresh: Float[Tensor, "batch frames features"], generator: torch.Generator) -> Tensor:
        """Half a batch of the fresh ones, half of kept ones; then the fresh half takes the place of kept ones."""
        half = len(fresh) // 2
        picked = torch.randperm(len(self.windows), generator=generator)
        mixed = torch.cat([fresh[: len(fresh) - half], self.windows[picked[:half]]])
        self.windows[picked[half : 2 * half]] = fresh[:half]
        return mixed

    def keep(self, fresh: Float[Tensor, "batch frames features"], generator: torch.Generator) -> None:
        """Put the fresh ones in the place of kept ones."""
        picked = torch.randperm(len(self.windows), generator=generator)[: len(fresh)]
        self.windows[picked] = fresh[: len(picked)]

    def draw(self, count: int, generator: torch.Generator) -> Float[Tensor, "count frames features"]:
        """Draw so many of the kept ones, any of them more than once."""
        return self.windows[torch.randint(len(self.windows), (count,), generator=generator)]


Row = dict[str, Any]
"""Losses of a step, or measures of held-out clips; in a curve None replaces what is not finite."""
Progress = Callable[[str], None]
"""Called with one line of news."""
_MOST_NAMED = 5  # files that a warning names


def ignore_line(line: str) -> None:
    """Take a line of news, and do nothing with it."""


C = TypeVar("C", bound=NetworkConfig)
S = TypeVar("S", bound=Any)  # settings: a frozen dataclass with at least `seed` and `steps`
T = TypeVar("T", bound=Trainer[Any])
G = TypeVar("G", bound=GradientTrainer[Any])


@dataclass(frozen=True)
class Gathered:
    """What a run is trained on."""

    corpus: Corpus
    """All clips."""
    parts: Split
    """The same, by what they are for."""

    def held_out(self) -> dict[str, list[str]]:
        """Return the clips that training does not see, for a card."""
        return {"validation": list(self.parts.validation.names), "test": list(self.parts.test.names)}

    def describe_training(self) -> dict[str, float]:
        """Describe how much motion training sees, for a card."""
        train = self.parts.train
        return {"clips": len(train.names), "minutes": round(len(train.features) / PRIOR_FPS / 60, 2)}


@dataclass(frozen=True)
class Export:
    """What a finished run writes, beside what every card holds."""

    tensors: Mapping[str, Tensor]
    """By name."""
    data: Row
    """What it was trained on, for the card."""
    quality: Row
    """Measures, for the card."""
    abilities: dict[str, float] = field(default_factory=dict)
    """Speeds and turning that the data show."""
    half: bool = True
    """Whether weights are kept in float16."""


@dataclass(frozen=True)
class Recipe(ABC, Generic[C, S, T]):
    """What to train on, and how. A model's subclass gives `config` and `settings` their defaults."""

    kind: ClassVar[str]
    """Name of the kind of model, in its card and on the command line."""
    keeps_best: ClassVar[bool] = False
    """Whether the weights of the best validation (see `score`) are exported even without `patience`."""
    uses_gpu: ClassVar[bool] = True
    """Whether it can be trained on a GPU."""

    data: Path
    """Folder of BVH files, searched below."""
    out: Path
    """Run folder: checkpoint, losses, finished model."""
    config: C
    """The network."""
    settings: S
    """How it is trained."""
    match: str | None = None
    """Regular expression that a file's path below `data` must contain."""
    cuts: Path | None = None
    """Table of the frames of each file that are motion; those named `Frame_Cuts.csv` in the folder are found."""
    level: bool = False
    """Put every clip on the canonical body and a level floor."""
    licence: str | None = None
    """Licence of the weights, for the card; that of the data if None, and of the weights that training began with."""
    resume: bool = False
    """Continue from the run folder's last checkpoint."""
    patience: int = 0
    """Validations without a better one after which training ends, with the best weights; 0 trains all steps."""
    checkpoint_minutes: float = 3.0
    """Between checkpoints."""
    report_steps: int = 100
    """Steps of whose losses the log holds the means."""
    validate_steps: int = 1000
    """Steps between two validations."""
    device: str = "auto"
    """Where to compute: `cpu`, `cuda`, or `auto` for a GPU where there is one."""

    def __post_init__(self):
        require_at_least(self, 1, "report_steps", "validate_steps")
        require_at_least(self, 0, "patience")

    @abstractmethod
    def make_trainer(self, parts: Split) -> T:
        """Make the trainer as it is before the first step."""

    @abstractmethod
    def score(self, row: Row) -> float:
        """Return the one number among measures of held-out clips that says how good a model is, smaller where it is
        better; NaN without one."""

    def check(self) -> None:
        """Raise RequestError for what cannot be, before anything is read."""
        if not self.data.is_dir():
            raise RequestError(f"{self.data} is not a folder of BVH files")
        if not os.access(self.data, os.R_OK | os.X_OK):
            raise RequestError(f"{self.data} cannot be read: permission denied")
        self.find_device()

    def find_device(self) -> str:
        """Return `cpu` or `cuda`; RequestError for one that this machine or model cannot have."""
        if self.device not in ("auto", "cpu", "cuda"):
            raise RequestError(f"device must be auto, cpu or cuda, got {self.device!r}")
        if self.device == "cuda" and not self.uses_gpu:
            raise RequestError(f"a {self.kind} is not trained on GPUs; use --device cpu")
        there = self.uses_gpu and torch.cuda.is_available()
        if self.device == "cuda" and not there:
            raise RequestError("this machine has no CUDA device; use --device cpu")
        return "cuda" if there and self.device != "cpu" else "cpu"

    @property
    def split_seed(self) -> int:
        """Seed by which clips are kept from training: that of the initial weights, where there are any, or the run
        would train on what their measures hold out."""
        init = getattr(self, "init", None)
        return self.settings.seed if init is None else int(_read_card(init).data.get("split_seed", self.settings.seed))

    @property
    def chosen(self) -> str:
        """Regular expression for the clips."""
        return self.match or ""

    def gather(self, progress: Progress, warn: Progress) -> Gathered:
        """Read the clips and split them; `warn` gets a line on files that were left out, RUN/skipped.txt has them all.

        RequestError where nothing is left, or what is left cannot be split.
        """

        def report(done: int, total: int) -> None:
            if done % 200 == 0 or done == total:
                progress(f"read {done} of {total} clips")

        corpus = read_corpus(
            self.data, match=self.chosen, cache=self.out / "cache", cuts=self.cuts, level=self.level, progress=report
        )
        if corpus.skipped:
            reasons = [f"{self.data / file.name}: {file.reason}" for file in corpus.skipped]
            count, more = len(reasons) + len(corpus.names), len(reasons) - _MOST_NAMED
            rest = f"; and {more} more, all in {self.out / 'skipped.txt'}" if more > 0 else ""
            warn(f"left out {len(reasons)} of {count} files: {'; '.join(reasons[:_MOST_NAMED])}{rest}")
            write_text(self.out / "skipped.txt", "".join(f"{file.name}: {file.reason}\n" for file in corpus.skipped))
        for line in corpus.cuts:
            progress(f"frames by {line}")
        parts = split_corpus(corpus, self.split_seed)
        size = f"{len(corpus.names)} clips, {len(corpus.features)} frames"
        held = f", without {parts.test.names[0]}, which is held out" if parts.validation is parts.test else ""
        progress(f"{size}; training on {len(parts.train.names)}{held}")
        return Gathered(corpus, parts)

    def find_shape(self, trainer: T) -> C:
        """Return the configuration of the network that is trained."""
        return self.config

    def describe_run(self, trainer: T, corpus: Corpus) -> dict[str, Row]:
        """Describe what must not change between a run's parts. The number of steps may, and the precision."""
        settings = {name: v for name, v in asdict(self.settings).items() if name not in ("steps", "bfloat16")}
        return {
            "settings": settings,
            "network": self.find_shape(trainer).as_card(),
            "data": corpus.identity() | {"split seed": self.split_seed},
        }

    def describe_origin(self) -> dict[str, dict[str, str]]:
        """Describe the model that training began with, and its licence, for a card's data; nothing without one."""
        init = getattr(self, "init", None)
        return {} if init is None else {"init": {"name": name_for_records(init), "licence": _read_card(init).licence}}

    def find_licence(self) -> str:
        """Return the licence of the weights, for the card."""
        init = self.describe_origin().get("init")
        return self.licence or (OF_DATA if init is None else f"{OF_DATA}; {init['licence']}")

    def describe_data(self, gathered: Gathered) -> Row:
        """Describe what training saw, for a card."""
        corpus = gathered.corpus
        return {
            **corpus.identity(),
            **corpus.describe_selection(),
            "match": self.chosen,
            "split_seed": self.split_seed,
            "held_out": gathered.held_out(),
        }

    def find_stop_reason(self, trainer: T, rows: Sequence[Row]) -> str | None:
        """Return why to stop after these losses since the last report, if there is a reason."""
        return None

    def finish(self, trainer: T) -> None:
        """Change the weights once more, before they are measured and written."""

    def export(self, trainer: T, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """Return what is written at the end."""
        quality = {"test": trainer.validate(gathered.parts.test)}
        return Export(trainer.exported.state_dict(), self.describe_data(gathered), quality)


@dataclass(frozen=True)
class NetworkRecipe(Recipe[C, S, G]):
    """Recipe of one network, which may start from another network's weights."""

    trainer_class: ClassVar[Callable[..., Any]]
    """Makes the trainer of a network's shape, settings and clips."""

    init: str | None = None
    """Begin with the weights of this model, bundled or trained."""
    init_share: float = 0.0
    """Share of those weights in the ones that are written: the mean of both is often better on familiar and on
    unfamiliar data than either (Wortsman et al. 2022)."""

    def __post_init__(self):
        super().__post_init__()
        if not 0 <= self.init_share < 1 or (self.init_share and self.init is None):
            raise RequestError(f"init_share must be from 0 to below 1, and needs init; got {self.init_share:g}")

    def draw_trainer(self, parts: Split) -> G:
        """Make the trainer with drawn weights."""
        return self.trainer_class(self.config, self.settings, parts.train)

    def make_trainer(self, parts: Split) -> G:
        """Make the trainer as it is before the first step."""
        trainer = self.draw_trainer(parts)
        trainer.grown = self.init is not None
        if self.init is not None and not self.resume:
            trainer.network.load_state_dict(self.read_initial_weights(self.init, trainer))
        return trainer

    def read_initial_weights(self, name: str, trainer: G) -> dict[str, Tensor]:
        """Read another model's weights for this trainer's network; CheckpointError if they are not of its shape."""
        tensors, card = checkpoints.load(checkpoints.locate(name))
        if card.kind != self.kind or type(self.config).of_card(card.config) != self.config:
            wanted = f"{self.kind} of {self.config.as_card()}"
            raise CheckpointError(f"{name} holds: {card.kind} of {card.config}; wanted: {wanted}")
        return trainer.network.state_dict() | tensors  # layers that the other lacks begin as drawn

    def finish(self, trainer: G) -> None:
        """Move the weights towards the initial ones, as far as those have a share."""
        if self.init is not None and self.init_share:
            before = self.read_initial_weights(self.init, trainer)
            for name, value in trainer.network.state_dict().items():
                if value.is_floating_point():
                    value.lerp_(before[name].to(value), self.init_share)

    def describe_run(self, trainer: G, corpus: Corpus) -> dict[str, Row]:
        """Describe what must not change between a run's parts."""
        return {**super().describe_run(trainer, corpus), "init": {"name": self.init}}


def average_logarithms(values: Iterable[float | None]) -> float:
    """Geometric mean of the positive ones among them, NaN of none: a tenth less of any counts alike."""
    logs = [math.log(value) for value in values if value is not None and value > 0]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def _read_card(name: str) -> checkpoints.Card:
    return checkpoints.read_card(checkpoints.locate(name).with_suffix(".json"))


CHECKPOINT, LOSSES, EVENTS = "checkpoint.safetensors", "losses.csv", "tensorboard"
"""Files and folder of a run folder."""
TRAINING, VALIDATION = "training", "validation"
"""What the column `part` of LOSSES holds: mean losses since the last report, or measures of held-out clips."""
_FIRST_LINE_SECONDS, _LINE_SECONDS = 5.0, 30.0  # to the first line on the losses, and from line to line


def train(recipe: Recipe[Any, Any, Any], progress: Progress = ignore_line, *, warn: Progress = ignore_line) -> Path:
    """Train to the end of the recipe, or until validation no longer improves, and write RUN/model.safetensors; return
    its path. `progress` gets lines on losses and validations, `warn` one on files that cannot be used.

    MapctlError where training diverges; the last checkpoint then stays as it was.
    """
    recipe.check()
    check_folder(recipe.out)
    present = (recipe.out / CHECKPOINT).exists()
    if recipe.resume and not present:
        raise CheckpointError(f"{recipe.out} holds no checkpoint to resume from")
    if present and not recipe.resume:
        raise RequestError(f"{recipe.out} already holds a run; pass --resume to continue it, or choose another folder")
    gathered = recipe.gather(progress, warn)
    with use_device(recipe.find_device()):
        run = TrainingRun(recipe, gathered, progress)
        run.go()
        return run.export()


class TrainingRun(Generic[C, S, T]):
    """A trainer, its curve of validations and its checkpoints."""

    def __init__(self, recipe: Recipe[C, S, T], gathered: Gathered, progress: Progress = ignore_line):
        self.recipe, self.gathered, self.progress = recipe, gathered, progress
        self.parts = gathered.parts.to(torch.get_default_device().type)
        self.trainer = recipe.make_trainer(self.parts)
        self.identity = json.loads(json.dumps(recipe.describe_run(self.trainer, gathered.corpus)))
        self.curve: list[Row] = []
        self.losses: list[Row] = []  # since the last report
        self.keeps_best = recipe.keeps_best or recipe.patience > 0
        self.best = _copy_weights(self.trainer.exported) if self.keeps_best else {}
        self.stop_reason: str | None = None
        if recipe.resume:
            self._load()
            progress(f"resumed at step {self.trainer.step}")
        self.log = Log(recipe.out, self.trainer.step)
        self.began, self.first_step = time.monotonic(), self.trainer.step
        self.due = self.began + _FIRST_LINE_SECONDS

    def go(self) -> None:
        """Train to the end of the run; see `train`."""
        saved = self.began
        while True:
            if self._validation_due():
                self.validate()
            ended = self.stop_reason is not None or self.trainer.step >= self.trainer.steps
            overdue = time.monotonic() - saved > 60 * self.recipe.checkpoint_minutes
            if self.trainer.step and (ended or overdue):
                self.save()
                saved = time.monotonic()
            if ended:
                break
            self.step()
        self.log.close()

    def step(self) -> None:
        """Take one step, and report on the last ones where it is time."""
        recipe, trainer = self.recipe, self.trainer
        self.losses.append(trainer.train_step())
        last = trainer.step >= trainer.steps
        if last or time.monotonic() >= self.due:
            self.due = time.monotonic() + _LINE_SECONDS
            self.progress(self._format_progress())
        if (reason := recipe.find_stop_reason(trainer, self.losses)) is not None:
            self._stop(reason)
        if last or trainer.step % recipe.report_steps == 0:
            self.log.write(trainer.step, TRAINING, _average(self.losses))
            self.losses = []

    def validate(self) -> None:
        """Measure the weights as they are, and stop where `patience` validations have brought nothing better."""
        recipe, trainer = self.recipe, self.trainer
        if not self.keeps_best:
            trainer.check_finite()
        measured = trainer.validate(self.parts.validation)
        row = {name: value if math.isfinite(value) else None for name, value in measured.items()}
        scores = [recipe.score(each) for each in [*self.curve, row]]
        scores = [math.inf if math.isnan(score) else score for score in scores]
        if self.keeps_best and all(scores[-1] < before for before in scores[:-1]):
            self.best = _copy_weights(trainer.exported)
        self.curve.append({"step": trainer.step, **row})
        self.log.write(trainer.step, VALIDATION, row)
        measures = ", ".join(f"{name} {'-' if value is None else f'{value:.4g}'}" for name, value in row.items())
        self.progress(f"validation at step {trainer.step}: {measures}")
        if recipe.patience and len(scores) - 1 - scores.index(min(scores)) >= recipe.patience:
            self._stop(f"no better in {recipe.patience} validations")

    def save(self) -> None:
        """Write a checkpoint, unless training was stopped, since what is resumed comes to the same end; MapctlError
        where the weights are not finite."""
        if self.stop_reason is not None:
            return
        if not self.keeps_best:
            self.trainer.check_finite()
        index = {"step": self.trainer.step, "identity": self.identity, "curve": self.curve}
        tensors = self.trainer.state() | {f"best.{name}": value for name, value in self.best.items()}
        write_tensors(self.recipe.out / CHECKPOINT, tensors, metadata={"run": json.dumps(index)})

    def export(self) -> Path:
        """Write the model with its card."""
        recipe, path = self.recipe, self.recipe.out / "model.safetensors"
        if self.keeps_best:
            self.trainer.exported.load_state_dict(self.best)
        for network in self.trainer.networks().values():
            network.to("cpu")
        recipe.finish(self.trainer)
        exported = recipe.export(self.trainer, self.gathered, self.curve)
        ended = {} if self.stop_reason is None else {"ended": f"step {self.trainer.step}: {self.stop_reason}"}
        card = checkpoints.Card(
            kind=recipe.kind,
            config=recipe.find_shape(self.trainer).as_card(),
            licence=recipe.find_licence(),
            data={**exported.data, **recipe.describe_origin(), "trained_on": self.gathered.describe_training()},
            training={"settings": asdict(recipe.settings), "curve": self.curve, **ended},
            quality=exported.quality,
            abilities=exported.abilities,
            **checkpoints.Card.layout_fields(),
        )
        checkpoints.save(dict(exported.tensors), card, path, half=exported.half)
        return path

    def _stop(self, reason: str) -> None:
        self.stop_reason = reason
        self.progress(f"{reason}: training ends with the best weights so far")

    def _format_progress(self) -> str:
        """Format the mean losses since the last report, the rate and the time left."""
        step, steps = self.trainer.step, self.trainer.steps
        rate = (step - self.first_step) / max(1e-9, time.monotonic() - self.began)
        losses = ", ".join(f"{name} {value:.3f}" for name, value in _average(self.losses).items())
        left = timedelta(seconds=round((steps - step) / rate))
        return f"step {step}/{steps}: {losses}, {rate:.3g} steps/s, {left} left"

    def _validation_due(self) -> bool:
        """Whether the weights have still to be measured: every so many steps and at the end, and, where a recipe keeps
        the best, before the first step."""
        if self.recipe.keeps_best and not self.curve:
            return True
        step, measured = self.trainer.step, self.curve[-1]["step"] if self.curve else 0
        due = step >= self.trainer.steps or step % self.recipe.validate_steps == 0
        return due and step > measured and self.stop_reason is None

    def _load(self) -> None:
        with _explain_unreadable(self.recipe.out):
            index, tensors = _read_checkpoint(self.recipe.out)
            for part, now in self.identity.items():
                then = index["identity"][part]
                changed = [f"{key}: {then.get(key)} then, {now[key]} now" for key in now if then.get(key) != now[key]]
                if changed:
                    raise CheckpointError(
                        f"{self.recipe.out}: the run was begun with other {part} ({'; '.join(changed)})"
                    )
            self.curve = [{**row, "step": int(row["step"])} for row in index["curve"]]
            self.trainer.load_state(tensors, int(index["step"]))
            if self.keeps_best:  # a run that was begun without patience kept none
                self.best = select_prefixed("best.", tensors) or _copy_weights(self.trainer.exported)
        if self.trainer.step > self.trainer.steps:
            done, wanted = self.trainer.step, self.trainer.steps
            raise RequestError(f"{self.recipe.out}: {done} steps are done; --steps must be at least that, got {wanted}")


class Log:
    """Mean losses and measures of held-out clips, as RUN/losses.csv and, where it is installed, for TensorBoard."""

    def __init__(self, run: Path, step: int):
        """Rows beyond `step`, at which the run goes on, are dropped: they come again."""
        self._path, self._rows, self._events = run / LOSSES, [], None
        if step and self._path.exists():
            with self._path.open(encoding="utf-8", newline="") as file:
                rows = [{name: cell for name, cell in row.items() if cell} for row in csv.DictReader(file)]
            self._rows = [row for row in rows if int(row["step"]) <= step]
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard.writer import SummaryWriter  # an optional extra, slow to import

            self._events = SummaryWriter(str(run / EVENTS), purge_step=step + 1 if step else None)

    def write(self, step: int, part: str, values: Mapping[str, Any]) -> None:
        """Add a row; values that are not finite numbers are left out."""
        finite = {name: v for name, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}
        self._rows.append({"step": str(step), "part": part, **{name: f"{v:.9g}" for name, v in finite.items()}})
        text = io.StringIO()
        columns = dict.fromkeys(name for row in self._rows for name in row)
        table = csv.DictWriter(text, list(columns), lineterminator="\n")
        table.writeheader()
        table.writerows(self._rows)
        write_text(self._path, text.getvalue())
        if self._events is not None:
            for name, value in finite.items():
                self._events.add_scalar(f"{part}/{name}", value, step)
            self._events.flush()

    def close(self) -> None:
        """Close the event files."""
        if self._events is not None:
            self._events.close()


def _average(rows: Sequence[Row]) -> Row:
    """Mean of each loss over the rows that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: [row[name] for row in rows if name in row] for name in names}
    return {name: sum(values) / len(values) for name, values in found.items()}


def read_index(run: Path) -> dict[str, Any]:
    """Read what the checkpoint of a run folder holds beside its tensors; CheckpointError where there is none."""
    with _explain_unreadable(run):
        return _read_checkpoint(run)[0]


def _read_checkpoint(run: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    with safe_open(run / CHECKPOINT, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return json.loads(file.metadata()["run"]), tensors


@contextmanager
def _explain_unreadable(run: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, SafetensorError) as error:
        raise CheckpointError(f"{run}: no readable checkpoint ({type(error).__name__}: {one_line(error)})") from error


def _copy_weights(network: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}
