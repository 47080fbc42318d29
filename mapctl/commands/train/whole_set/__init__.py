"""`mapctl train all`: every model that comes with mapctl, from scratch."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class TrainAll(Command):
    """Train every model that comes with mapctl from scratch, each until its curve is flat and after those it needs.

    What is finished is skipped, and what was interrupted goes on. OUT/weights then holds the set.
    """

    model: ClassVar[str] = "all"
    """As the command line calls it."""

    data: options.MaybeDataFolder = None
    """Folder of .bvh files, searched with everything below it."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="DIR")] = None
    """Folder of the set: a run folder for each model by its name, weights/ with all that are finished, curves.png."""
    weights: Annotated[Literal["full", "free"], arg(metavar="full|free")] = "full"
    """Which set: of all clips (full), or of takes of the CMU database alone, with weights free for any use (free)."""
    match: Annotated[str | None, arg(metavar="REGEX")] = None
    """Clips of your own for the densities of walks and runs, by what their paths hold; those have no labels then."""
    licence: Annotated[str | None, arg(metavar="TEXT")] = None
    """Licence of the weights, for their cards; if not given, that of the set if all clips are the set's own, else `that
    of the training data`."""
    made: options.MaybeDataFolder = None
    """Folder of clips that mapctl make has made, which the densities of walks and runs are trained on as well."""
    only: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Models to train; what they need must be among them or finished."""
    seed: options.Count = 1
    """Seed of weights, windows and noise. The clips that are kept from training stay the same."""
    data_share: options.Number = 1.0
    """Share of the clips to train on, to see what more would bring. The clips that are kept from training stay the
    same, and those of a smaller share are among those of a larger one."""
    jobs: options.Count = 1
    """Models that are trained at once, each by a process of one thread: as many as there are cores pay."""
    minutes: options.Number = 360.0
    """Minutes of one core that a model takes at most; its learning rate is then brought to its end. Densities have a
    number of steps instead."""
    quiet: bool = False
    """No lines of the models' own, but for what is wrong."""
    commands: bool = False
    """Print each model's command instead of training it."""
    check: Annotated[Path | None, arg(metavar="OUT")] = None
    """Print the table of a set and its size instead; exit status 3 where it is over 64 MB or lacks a model."""
    compare: Annotated[tuple[Path, Path] | None, arg(metavar="OUT1 OUT2")] = None
    """Print how good the models of two sets are, of two seeds say, instead."""
    by_motion: Annotated[tuple[Path, ...] | None, arg(metavar="OUT OUT ...")] = None
    """Print how good the models of sets with different shares of the clips are, by how much motion they were trained
    on, and draw it as -o FILE.png, instead."""
    within: options.Number = 5.0
    """With --compare: percent by which the errors of two may differ; exit status 3 where they differ more."""

    def format_command(self) -> list[str]:
        """What to type for the same; options that are the defaults are left out."""
        typed = ["mapctl", "train", self.model]
        for option in fields(self):
            value, name = getattr(self, option.name), f"--{option.name.replace('_', '-')}"
            if value == option.default:
                continue
            typed += [name] if value is True else [f"{name}={value}"] if str(value)[:1] == "-" else [name, str(value)]
        return typed
