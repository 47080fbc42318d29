"""What a training run needs: data and settings. A model's own recipe says what is learnt, judged and described."""

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

from torch import Tensor

from mapctl.errors import CheckpointError, RequestError
from mapctl.features import PRIOR_FPS
from priors import checkpoints
from priors.config import NetworkConfig, require_at_least
from priors.licences import OF_DATA
from priors.training.corpus import Corpus, Split
from priors.training.devices import check_processes, refuse_gpu, select_device
from priors.training.ending.course import VALIDATIONS, End, UntilFlat
from priors.training.ending.flatness import Point
from priors.training.gathering import DataSource, describe_selection, find_split_seed, name_origin
from priors.training.trainer import GradientTrainer, Trainer

Row = dict[str, Any]
"""Losses of a step, or measures of held-out clips; in a curve None replaces what is not finite."""


@runtime_checkable
class Settings(Protocol):
    """How a model is trained: a frozen dataclass with at least a seed."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def seed(self) -> int:
        """Seed of everything random, including the split of the clips."""
        ...


_TOLD = ("steps", "batch", "window", "pairs", "learning_rate", "seed")  # settings that are options of the command

C = TypeVar("C", bound=NetworkConfig)
S = TypeVar("S", bound=Settings)
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
        """For a card: the clips that training does not see."""
        return {"validation": list(self.parts.validation.names), "test": list(self.parts.test.names)}

    def describe_training(self) -> dict[str, float]:
        """For a card: how much motion training sees."""
        train = self.parts.train
        return {"clips": len(train.names), "minutes": round(len(train.features) / PRIOR_FPS / 60, 2)}


@dataclass(frozen=True)
class Export:
    """What a finished run writes, beside what every card tells."""

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
    counter: ClassVar[str] = "step"
    """What one step of its trainer is called."""
    steps_name: ClassVar[str] = "steps"
    """Setting that tells how many there are in all."""
    guards: ClassVar[tuple[str, ...]] = ()
    """Losses by which training may end by itself (see `find_stop_reason`). Where there are any, they are saved with the
    checkpoints, and the best weights so far (see `score`) are exported instead of the last."""
    falls: ClassVar[bool] = True
    """Whether the learning rate falls to nothing at the end, which then has to be known before it comes."""
    decay_cost: ClassVar[float] = 1.0
    """How much longer a step takes in the decay of a run until its curve is flat than before it."""
    uses_gpu: ClassVar[bool] = True
    """Whether it can be trained on a GPU."""
    headline: ClassVar[str] = "error"
    """What `find_headline` tells: the one number that says how good a model is, smaller where it is better."""

    data: Path
    """Folder of BVH files, searched below."""
    out: Path
    """Run folder: checkpoint, curve, finished model."""
    config: C
    """The network."""
    settings: S
    """How it is trained."""
    match: str | None = None
    """Regular expression that a file's path below `data` must contain."""
    resume: bool = False
    """Continue from the run folder's last checkpoint."""
    checkpoint_minutes: float = 3.0
    """Between checkpoints."""
    report_steps: int = 100
    """Between lines of news."""
    validate_steps: int = 1000
    """Steps between two validations; until its curve is flat a run has its own."""
    processes: int = 1
    """Processes that share the batch of each step: forked where there are several, unless torchrun has started them."""
    licence: str = OF_DATA
    """Licence of the weights, for the card, one line."""
    skip_first: bool = False
    """Drop frame 0 of every clip (the T-pose of CMU takes)."""
    cuts: Path | None = None
    """Table of the frames of each file that are motion; those named `Frame_Cuts.csv` in the folder are found."""
    level: bool = False
    """Put every clip on the canonical body and a level floor."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used, rather than leave the file out."""
    split: int | None = None
    """Seed by which clips are kept from training, where it is not that of all that is random."""
    data_share: float = 1.0
    """Share of the clips to train on that are used; the clips that are held out stay the same."""
    until_flat: UntilFlat | None = None
    """Train until the curve of validations is flat; the settings' steps are then a plan."""
    minutes: float | None = None
    """Of one core, within which training ends as if it were finished."""
    device: str = "auto"
    """Where to compute: `cpu`, `cuda`, or `auto` for a GPU where there is one."""

    def __post_init__(self):
        require_at_least(self, 1, "report_steps", "validate_steps", "processes")

    @abstractmethod
    def make_trainer(self, parts: Split) -> T:
        """As it is before the first step."""

    def check(self) -> None:
        """Before anything is read."""
        if not self.data.is_dir():
            raise RequestError(f"{self.data} is not a folder of BVH files")
        if not os.access(self.data, os.R_OK | os.X_OK):
            raise RequestError(f"{self.data} cannot be read: permission denied")
        check_processes(self.find_device(), self.processes, self.kind)
        if self.processes > self.most_processes:
            raise RequestError(
                f"{self.processes} processes cannot share what a {self.counter} of {self.kind} takes:"
                f" {self.most_processes} at most"
            )
        if self.minutes is not None and self.falls and self.until_flat is None:
            raise RequestError(
                f"minutes limit a {self.kind} only until its curve is flat (--until-flat):"
                f" otherwise its learning rate goes by its {self.counter}s"
            )

    def find_device(self) -> str:
        """`cpu` or `cuda`; RequestError for one that this process cannot have, or on which nothing would be faster."""
        if self.uses_gpu:
            return select_device(self.device)
        refuse_gpu(self.device, self.kind)
        return "cpu"

    @property
    def most_processes(self) -> int:
        """How many processes can share a step."""
        return int(getattr(self.settings, "batch", 1))

    @property
    def steps(self) -> int:
        """Steps in all, as the settings call them."""
        return int(getattr(self.settings, self.steps_name))

    def source(self) -> DataSource:
        """Where motion comes from."""
        return DataSource(
            self.data,
            self.out,
            self.match or "",
            self.skip_first,
            self.strict_data,
            cuts=self.cuts,
            level=self.level,
            seed=self.split_seed,
            share=self.data_share,
            licence=self.licence,
            teachers=self.list_teachers(),
        )

    @property
    def split_seed(self) -> int:
        """Seed by which clips are kept from training."""
        return self.settings.seed if self.split is None else self.split

    def list_teachers(self) -> tuple[str, ...]:
        """Models that the weights begin with or learn from, bundled or trained."""
        return (init,) if (init := getattr(self, "init", None)) is not None else ()

    def find_shape(self, trainer: T) -> C:
        """Return the configuration of the network that is trained."""
        return self.config

    def describe_data(self, corpus: Corpus) -> dict[str, str]:
        """What tells the data of this run from others'."""
        return corpus.identity() | self.describe_split()

    def describe_split(self) -> dict[str, str]:
        """The seed by which clips are kept from training, where it was told."""
        return {} if self.split is None else {"split seed": str(self.split)}

    def pin(self, trainer: T, corpus: Corpus) -> dict[str, Row]:
        """What must not change between a run's parts. The number of steps may, to extend it, and the precision."""
        fixed = asdict(self.settings).keys() - {self.steps_name, "bfloat16"}
        return {
            "settings": {name: value for name, value in asdict(self.settings).items() if name in fixed},
            "network": self.find_shape(trainer).as_card(),
            "data": self.describe_data(corpus),
        }

    def format_news(self, rows: Sequence[Row]) -> str:
        """One line on the losses of some steps."""
        return ", ".join(f"{name} {average(rows, name):.3f}" for name in rows[0])

    def find_stop_reason(self, trainer: T, rows: Sequence[Row]) -> str | None:
        """Why to stop after these losses since the last line of news, if there is a reason."""
        return None

    def score(self, row: Row) -> float:
        """How far measures are from what is wanted."""
        return 0.0

    @property
    def validation_steps(self) -> int:
        """Steps between two validations: of a run until its curve is flat so many that the curve can be judged."""
        return self.validate_steps if self.until_flat is None else max(1, self.steps // VALIDATIONS)

    def least_steps(self) -> int:
        """Steps before which no curve is flat: until then something grows or joins."""
        return self.steps // 2

    def tell_end(self, end: End | None) -> "Recipe[C, S, T]":
        """The recipe by which any other run ends where this one did: it tells what a clock has decided."""
        if end is None or not end.by_clock:
            return self
        if self.until_flat is not None:
            return replace(self, until_flat=replace(self.until_flat, decay_from=end.decay))
        return replace(self, settings=replace(self.settings, **{self.steps_name: end.decay.end}))

    @classmethod
    def find_headline(cls, row: Row) -> float:
        """Find the one number among measures of held-out clips that says how good a model is; NaN without one."""
        return math.nan

    @classmethod
    def find_card_headline(cls, quality: Row) -> float:
        """Find it in the quality that a card tells: that of the test clips, where there is no other."""
        return cls.find_headline(quality.get("test", quality))

    @classmethod
    def find_log_error(cls, row: Row) -> float:
        """The logarithm of the error that a row of measures tells: 0.01 less is one percent better."""
        return cls.as_log_error(cls.find_headline(row))

    @classmethod
    def as_log_error(cls, value: float) -> float:
        """The same of the one number that `find_headline` tells."""
        return math.log(value) if 0 < value < math.inf else math.nan

    def find_points(self, curve: Sequence[Row]) -> list[Point]:
        """The curve of validations as it is looked at for being flat."""
        points = [(int(row[self.counter]), self.find_log_error(row)) for row in curve]
        return [point for point in points if math.isfinite(point[1])]

    def finish(self, trainer: T) -> None:
        """Change the weights once more, before they are measured and written."""

    def export(self, trainer: T, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """What is written at the end."""
        corpus = gathered.corpus
        data = {
            **self.describe_data(corpus),
            **describe_selection(corpus),
            "match": self.match or "",
            "split_seed": self.split_seed,
            "held_out": gathered.held_out(),
        }
        return Export(trainer.network.state_dict(), data, {"test": trainer.validate(gathered.parts.test)})

    def format_shape(self) -> list[str]:
        """Options of the command that the network's shape needs; those that are the defaults are left out."""
        return []

    def usual_settings(self) -> S:
        """Settings of which the command needs no options."""
        return type(self.settings)()

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        told = [name for name in _TOLD if hasattr(self.settings, name)]
        parts = [f"mapctl train {self.kind} --data DATA -o RUN"]
        parts += [f"--match '{self.match}'"] if self.match else []
        parts += self.format_reading() + self.format_shape()
        parts += self.format_changed(self.usual_settings(), *told)
        return " ".join(parts + self.format_processes() + self.format_ending())

    def format_ending(self) -> list[str]:
        """The options for a split of its own, and for a run until its curve is flat."""
        parts = [] if self.split is None else [f"--split-seed {self.split}"]
        if self.until_flat is None:
            return parts
        share, given = self.until_flat.share, self.until_flat.decay_from
        parts += ["--until-flat"] if share == UntilFlat.share else [f"--until-flat --flat-share {share:g}"]
        return parts + ([] if given is None else [f"--decay-from {given}"])

    def format_reading(self) -> list[str]:
        """The options for how clips are read, where they are not the defaults."""
        parts = ["--skip-first"] * self.skip_first + ["--level"] * self.level
        parts += [] if self.data_share == 1 else [f"--data-share {self.data_share:g}"]
        return parts + ([f"--cuts {self.cuts.name}"] if self.cuts else [])

    def format_processes(self) -> list[str]:
        """The option for several processes, where there were any."""
        return [f"--processes {self.processes}"] if self.processes > 1 else []

    def format_changed(self, usual: Any, *names: str, **renamed: str) -> list[str]:
        """Options for settings that are not the `usual` ones; `renamed` are those whose option is called otherwise."""
        options = {name: name for name in names} | renamed
        return [
            f"--{option.replace('_', '-')} {getattr(self.settings, name)}"
            for name, option in options.items()
            if getattr(self.settings, name) != getattr(usual, name)
        ]


@dataclass(frozen=True)
class NetworkRecipe(Recipe[C, S, G]):
    """Recipe of one network on the usual card, which may start from another network's weights."""

    init: str | None = None
    """Begin with the weights of this model, bundled or trained."""
    init_share: float = 0.0
    """Share of those weights in the ones that are written: the mean of both is often better on familiar and on
    unfamiliar data than either (Wortsman et al. 2022)."""

    @property
    def split_seed(self) -> int:
        """That of the initial weights, where there are any."""
        return find_split_seed(self.init, self.settings.seed, self.split)

    @abstractmethod
    def make_untaught(self, parts: Split) -> G:
        """The trainer, its weights drawn."""

    def make_trainer(self, parts: Split) -> G:
        """As it is before the first step."""
        trainer = self.make_untaught(parts)
        if self.init is not None and not self.resume:
            trainer.network.load_state_dict(self.read_initial_weights(self.init, trainer))
        return trainer

    def read_initial_weights(self, name: str, trainer: G) -> dict[str, Tensor]:
        """Another model's weights for this trainer's network; CheckpointError if they are not of its shape."""
        tensors, card = checkpoints.load(checkpoints.locate(name))
        if card.kind != self.kind or type(self.config).of_card(card.config) != self.config:
            wanted = f"{self.kind} of {self.config.as_card()}"
            raise CheckpointError(f"{name} holds: {card.kind} of {card.config}; wanted: {wanted}")
        return trainer.network.state_dict() | tensors  # layers that the other lacks begin as drawn

    def finish(self, trainer: G) -> None:
        """Bring the weights towards the initial ones, as far as those have a share."""
        if self.init is not None and self.init_share:
            before = self.read_initial_weights(self.init, trainer)
            for name, value in trainer.network.state_dict().items():
                if value.is_floating_point():
                    value.lerp_(before[name].to(value), self.init_share)

    def pin(self, trainer: G, corpus: Corpus) -> dict[str, Row]:
        """What must not change between a run's parts."""
        return {**super().pin(trainer, corpus), "init": {"name": self.init}}

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        parts = [f"--init {name_origin(self.init)}"] if self.init is not None else []
        parts += [f"--init-share {self.init_share:g}"] if self.init_share else []
        parts += ["--bfloat16"] * bool(getattr(self.settings, "bfloat16", False))
        return " ".join([super().format_command(), *parts])


def average_logarithms(values: Iterable[float | None]) -> float:
    """Geometric mean of the positive ones among them, NaN of none: a tenth less of any counts alike."""
    logs = [math.log(value) for value in values if value is not None and value > 0]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def average(rows: Sequence[Row], name: str) -> float:
    """Mean of a part of the loss."""
    return sum(row[name] for row in rows) / len(rows)
