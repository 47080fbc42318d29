"""What `mapctl train` asks of any model: the options that all have, their checks, and the run."""

import shlex
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.resumption import explain_end
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipe import Recipe

_COUNTS = ("width", "components", "steps", "batch", "window", "pairs")


@dataclass(frozen=True)
class TrainOptions(ABC):
    """Options of `train` for any model. A model's own class adds its options and makes the recipe."""

    model: ClassVar[str]
    """As the command line calls it."""
    used_by: ClassVar[str]
    """How commands take what was trained."""
    single_thread: ClassVar[bool] = True
    """Whether training is fastest on one."""

    data: options.DataFolder
    """Folder of .bvh files, searched with everything below it."""
    out: options.OutFolder
    """Run folder: checkpoints, training curve, and at the end model.safetensors with its card."""
    match: Annotated[str | None, arg(metavar="REGEX")] = None
    """Only clips whose path below the data folder holds this regular expression."""
    steps: options.MaybeCount = None
    """Optimiser steps in all."""
    seed: options.MaybeCount = None
    """Seed of weights, windows, noise and the split of the clips."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    minutes_between_checkpoints: options.Number = 3.0
    """How much a kill may cost."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used; if not given, such files are left out and listed."""
    licence: Annotated[str, arg(metavar="TEXT")] = "that of the training data"
    """Licence of the weights, for their card."""
    quiet: bool = False
    """No lines of news."""

    @abstractmethod
    def recipe(self) -> "Recipe[Any, Any, Any]":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""

    def run(self) -> int:
        """Check, train, name the result."""
        with explain_end(self._describe_resumption):
            recipe = self.recipe()
            from mapctl.commands.shared import outputs

            outputs.check_folder(self.out)
            if self.single_thread:
                use_single_thread()
            from priors.training import run

            path = run.train(recipe, (lambda line: None) if self.quiet else _print_line, warn=_warn)
        if not self.quiet:
            print(f"wrote {path}; {self.used_by} {self.out}")
        return 0

    def check(self) -> None:
        """RequestError for numbers that make no sense for any model."""
        for name, value in self.select_given(*_COUNTS).items():
            if value < 1:
                raise RequestError(f"--{name} must be at least 1, got {value}")
        if self.seed is not None:
            options.check_seed(self.seed)
        rate = getattr(self, "learning_rate", None)
        if rate is not None and not 0 < rate < 1:
            raise RequestError(f"the learning rate must lie between 0 and 1, got {rate:g}")
        if not self.minutes_between_checkpoints > 0:
            raise RequestError(
                f"minutes between checkpoints must be positive, got {self.minutes_between_checkpoints:g}"
            )

    def common(self) -> dict[str, Any]:
        """What every recipe takes, checked."""
        self.check()
        return {
            "data": self.data,
            "out": self.out,
            "match": self.match,
            "resume": self.resume,
            "checkpoint_minutes": self.minutes_between_checkpoints,
            "strict_data": self.strict_data,
            "licence": self.licence,
        }

    def select_given(self, *names: str, **renamed: str) -> dict[str, Any]:
        """The options among `names` that were given, for `replace`; `renamed` are those that a recipe calls otherwise,
        as in `rounds="steps"`.
        """
        options_of = {name: name for name in names} | renamed
        found = {name: getattr(self, option, None) for name, option in options_of.items()}
        return {name: value for name, value in found.items() if value is not None}

    def format_command(self) -> list[str]:
        """What to type for a command; options that are the defaults are left out."""
        typed = ["mapctl", "train", self.model]
        for option in fields(self):
            value, name = getattr(self, option.name), f"--{option.name.replace('_', '-')}"
            if value == option.default:
                continue
            if value is True:
                typed.append(name)
            elif str(value).startswith("-"):
                typed.append(f"{name}={value}")
            else:
                typed += [name, str(value)]
        return typed

    def _describe_resumption(self) -> str:
        """Empty where the run folder holds no checkpoint."""
        from priors.training.run_files import read_last_step

        step = read_last_step(self.out)
        typed = shlex.join([*replace(self, resume=False).format_command(), "--resume"])
        return "" if step is None else f"step {step} is saved; go on with: {typed}"


@dataclass(frozen=True)
class NetworkOptions(TrainOptions):
    """Options of any network that learns from windows of clips."""

    batch: options.MaybeCount = None
    """Windows a step."""
    window: options.MaybeCount = None
    """Frames a window."""
    bfloat16: bool = False
    """Let the network compute in bfloat16: faster where the processor has it."""


@dataclass(frozen=True)
class TunableOptions(NetworkOptions):
    """Options of any network that may start from another network's weights."""

    learning_rate: options.MaybeNumber = None
    """At its highest; 0.001 from scratch, less to fine-tune."""
    init: Annotated[str | None, arg(metavar="NAME")] = None
    """Begin with the weights of this model, bundled or trained, and fine-tune them."""
    skip_first: bool = False
    """Leave out frame 0 of every clip (the T-pose of CMU takes)."""


@dataclass(frozen=True)
class ParallelOptions(TunableOptions):
    """Options of any network whose batches several processes can share."""

    processes: options.Count = 1
    """Processes that compute the gradients of a step, each of --batch of its own; one for each core pays."""


def _print_line(line: str) -> None:
    # Flushed, so that a log file shows how far a run of hours has come.
    print(line, flush=True)


def _warn(line: str) -> None:
    """Say it where --quiet and redirected output do not hide it."""
    print(f"mapctl: {line}", file=sys.stderr, flush=True)
