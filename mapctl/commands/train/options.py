"""What `mapctl train` asks of any model: the options that all have, their checks, and the run."""

import math
import os
import re
import shlex
import signal
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from mapctl.commands.shared import exit_status, options
from mapctl.commands.shared.resumption import explain_end
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import MapctlError, RequestError

if TYPE_CHECKING:
    from pathlib import Path

    from priors.training.ending.course import UntilFlat
    from priors.training.recipe import Recipe

CURVES = "curves.png"
"""Of the plot in the run folder."""
_COUNTS = ("width", "components", "steps", "batch", "window", "pairs", "processes")


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
    cuts: options.MaybeFile = None
    """Table (CSV) of file, first and last frame: which frames are motion; `cmu` is the one for takes of CMU that comes
    with mapctl. Each Frame_Cuts.csv in the data folder is found by itself (docs/guides/data.md)."""
    level: bool = False
    """Put every clip on the canonical body and a level floor: for captures whose floor slopes or whose feet rest at
    other heights, as those of CMU."""
    steps: options.MaybeCount = None
    """Optimiser steps in all; with --resume, more than before extend a run, also a finished one."""
    seed: options.MaybeCount = None
    """Seed of weights, windows, noise and the split of the clips."""
    split_seed: options.MaybeCount = None
    """Seed of the split of the clips alone, to compare runs of several seeds on the same unseen clips."""
    data_share: options.Number = 1.0
    """Share of the clips to train on that are used, drawn with the split's seed, to see what more motion would bring;
    the clips that are held out stay the same."""
    minutes: options.MaybeNumber = None
    """Of one core, within which training ends as if it were finished; networks need --until-flat for it."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    minutes_between_checkpoints: options.Number = 3.0
    """How much a kill may cost."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used; if not given, such files are left out and listed."""
    licence: Annotated[str | None, arg(metavar="TEXT")] = None
    """Licence of the weights, for their card; if not given, that of the run so far with --resume, else `that of the
    training data`."""
    plot: bool = False
    """Draw the losses and validations so far as RUN/curves.png at each validation."""
    quiet: bool = False
    """No table or lines of news."""

    @abstractmethod
    def recipe(self) -> "Recipe[Any, Any, Any]":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""

    def run(self) -> int:
        """Check, train, name the result. Of processes that torchrun started only the first speaks."""
        if not self._leads():
            return self._run_silently()
        with explain_end(self._describe_resumption):
            path = self._train()
        if not self.quiet:
            print(f"wrote {path}; {self.used_by} {self.out}")
        return 0

    def _train(self) -> "Path":
        recipe = self._keep_told().recipe()
        from mapctl.commands.shared import outputs

        outputs.check_folder(self.out)
        if self.plot:
            outputs.require_render("matplotlib")
        if self.single_thread or recipe.processes > 1:
            use_single_thread()
        from mapctl.commands.train import progress
        from priors.training import run

        with progress.watch(quiet=self.quiet, plot=self.out / CURVES if self.plot else None) as watchers:
            say = (lambda line: None) if self.quiet else progress.print_line
            return run.train(recipe, say, warn=progress.warn, watchers=watchers)

    def _leads(self) -> bool:
        if "RANK" not in os.environ:  # torch is not imported before the options are known to make sense
            return True
        from priors.training.parallel import leads_launched

        return leads_launched()

    def _run_silently(self) -> int:
        """Train as another process than the first, which says why training ends; but for what only this one knows."""
        from priors.training.parallel import LostProcessError

        try:
            self._train()
        except LostProcessError:
            raise
        except MapctlError:
            return exit_status.INVALID
        except KeyboardInterrupt:
            return exit_status.SIGNALLED + signal.SIGTERM
        return 0

    def _keep_told(self) -> "TrainOptions":
        """A run that is resumed without --steps has as many as before, and without --licence the one that it had."""
        if not self.resume:
            return self
        from priors.training.run_files import read_licence, read_total_steps

        steps = read_total_steps(self.out) if self.steps is None else self.steps
        return replace(self, steps=steps, licence=read_licence(self.out) if self.licence is None else self.licence)

    def check(self) -> None:
        """RequestError for numbers that make no sense for any model."""
        for name, value in self.select_given(*_COUNTS).items():
            if value < 1:
                raise RequestError(f"--{name} must be at least 1, got {value}")
        for seed in (self.seed, self.split_seed):
            if seed is not None:
                options.check_seed(seed)
        check_share(self.data_share)
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise RequestError(f"--minutes must be positive, got {self.minutes:g}")
        rate = getattr(self, "learning_rate", None)
        if rate is not None and not 0 < rate < 1:
            raise RequestError(f"the learning rate must lie between 0 and 1, got {rate:g}")
        check_licence(self.licence)
        if not self.minutes_between_checkpoints > 0:
            raise RequestError(
                f"minutes between checkpoints must be positive, got {self.minutes_between_checkpoints:g}"
            )

    def common(self) -> dict[str, Any]:
        """What every recipe takes, checked."""
        self.check()
        shared = self.select_given("processes", "licence")
        return {
            **shared,
            "data": self.data,
            "out": self.out,
            "match": self.match,
            "cuts": self.cuts,
            "level": self.level,
            "resume": self.resume,
            "checkpoint_minutes": self.minutes_between_checkpoints,
            "strict_data": self.strict_data,
            "split": self.split_seed,
            "data_share": self.data_share,
            "minutes": self.minutes,
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
    """Let the network compute in bfloat16: faster. On a processor that does not have it, training says so and computes
    in float32."""
    processes: options.Count = 1
    """Processes of this machine that share each step's batch, one a core; several machines: torchrun
    (docs/guides/training.md)."""


@dataclass(frozen=True)
class TunableOptions(NetworkOptions):
    """Options of any network that may start from another network's weights."""

    learning_rate: options.MaybeNumber = None
    """At its highest; 0.001 from scratch, less to fine-tune."""
    init: Annotated[str | None, arg(metavar="NAME")] = None
    """Begin with the weights of this model, bundled or trained, and fine-tune them."""
    init_share: Annotated[float, arg(metavar="NUMBER")] = 0.0
    """Share of the weights of --init in the ones that are written, the rest being the fine-tuned ones': 0.7 keeps most
    of what the initial model knew (Wortsman et al. 2022)."""
    device: Annotated[Literal["auto", "cpu", "cuda"], arg(metavar="auto|cpu|cuda")] = "auto"
    """Where to compute; auto is a GPU with CUDA where there is one."""
    skip_first: bool = False
    """Leave out frame 0 of every clip (the T-pose of CMU takes)."""
    until_flat: bool = False
    """Train until the curve of validations is flat, then let the learning rate fall; --steps is a plan, by which gaps
    grow, of which a half is trained at least and three times as many at most (docs/guides/training.md)."""
    flat_share: options.MaybeNumber = None
    """Flat is a curve whose error falls by less than this share over the last third of the steps; 0.02."""
    decay_from: Annotated[str | None, arg(metavar="STEP:STEPS")] = None
    """With --until-flat: let the learning rate fall from this step on, over so many, whatever the curve is like: what
    the card names of a run that --minutes has ended."""

    def check(self) -> None:
        """RequestError for numbers that make no sense for any model."""
        super().check()
        if not self.until_flat and (self.flat_share is not None or self.decay_from is not None):
            raise RequestError("--flat-share and --decay-from are for --until-flat")
        if self.until_flat and getattr(self, "paper", False):
            raise RequestError("--paper has a learning rate and a length of its own: leave out --until-flat")
        if not 0 <= self.init_share < 1 or (self.init_share and self.init is None):
            raise RequestError(f"--init-share must be from 0 to below 1, and needs --init; got {self.init_share:g}")
        if self.flat_share is not None and not 0 < self.flat_share < 1:
            raise RequestError(f"--flat-share must lie between 0 and 1, got {self.flat_share:g}")

    def common(self) -> dict[str, Any]:
        """What every recipe takes, checked."""
        common = super().common()
        if self.licence is None and self.init is not None:
            common["licence"] = self._describe_licence(self.init)
        rule = self._make_rule() if self.until_flat else None
        blend = {"init_share": self.init_share} if self.init_share else {}
        return {**common, **blend, "device": self.device, "until_flat": rule}

    def _describe_licence(self, init: str) -> str:
        from priors import checkpoints, licences

        card = checkpoints.read_card(checkpoints.locate(init).with_suffix(".json"))
        return f"{licences.OF_DATA}; {card.licence}"

    def _make_rule(self) -> "UntilFlat":
        from priors.training.ending.course import UntilFlat
        from priors.training.ending.decay import Decay

        decay = None if self.decay_from is None else Decay(*_parse_decay(self.decay_from))
        return UntilFlat(decay_from=decay, **self.select_given(share="flat_share"))


def _parse_decay(text: str) -> tuple[int, int]:
    begin, _, steps = text.partition(":")
    if not (begin.isdecimal() and steps.isdecimal()):
        raise RequestError(f"--decay-from is STEP:STEPS, as 8000:2000, got {text!r}")
    return int(begin), int(steps)


def check_share(share: float) -> None:
    """RequestError for a share of the clips that is not above 0 and at most 1."""
    if not 0 < share <= 1:
        raise RequestError(f"--data-share must be above 0 and at most 1, got {share:g}")


def check_licence(licence: str | None) -> None:
    """RequestError for a licence that is not one line of text: an empty one would leave the model out of every mark."""
    if licence is not None and (not licence.strip() or len(licence.splitlines()) > 1):
        raise RequestError(f"--licence must be one line of text, got {licence!r}")


def check_pattern(match: str | None) -> None:
    """RequestError for what is no regular expression."""
    try:
        re.compile(match or "")
    except re.error as error:
        raise RequestError(f"--match must be a regular expression, got {match!r} ({error})") from error
