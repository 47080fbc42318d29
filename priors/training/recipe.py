"""What a training run needs: data and settings. A model's own recipe says what is trained, measured and written."""

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from torch import Tensor

from mapctl.errors import CheckpointError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats.atomic import write_text
from priors import checkpoints
from priors.checkpoints import NetworkConfig, require_at_least
from priors.licences import OF_DATA
from priors.training.corpus import Corpus, Split, read_corpus, split_corpus
from priors.training.trainer import GradientTrainer, Trainer, select_device
from priors.weight_sets import name_for_records

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
    skip_first: bool = False
    """Drop frame 0 of every clip (the T-pose of CMU takes)."""
    cuts: Path | None = None
    """Table of the frames of each file that are motion; those named `Frame_Cuts.csv` in the folder are found."""
    level: bool = False
    """Put every clip on the canonical body and a level floor."""
    licence: str = OF_DATA
    """Licence of the weights, for the card, one line."""
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
        if not self.uses_gpu and self.device == "cuda":
            raise RequestError(f"a {self.kind} is not trained on GPUs; use --device cpu")
        return select_device(self.device) if self.uses_gpu else "cpu"

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

        cache, cuts = self.out / "cache", self.cuts
        corpus = read_corpus(
            self.data,
            match=self.chosen,
            cache=cache,
            skip_first=self.skip_first,
            cuts=cuts,
            level=self.level,
            progress=report,
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
