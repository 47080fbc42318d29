"""Base of all sub-commands: threads, exit statuses, weights and the licence of the result."""

import gc
import os
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, ClassVar

from mapctl.commands.shared import options

if TYPE_CHECKING:
    from mapctl.problem.solution import Status


def use_single_thread() -> None:
    """Compute with one thread: on matrices this small two fight. Takes full effect before numpy is first imported."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    import torch

    torch.set_num_threads(1)


UNREAD = 1
"""The output was not read: a broken pipe."""
INVALID = 2
"""The input or the command is wrong, or a disk is full."""
NOT_SATISFIED = 3
"""Done, but not all that was requested holds."""
SIGNALLED = 128
"""Ended by a signal, whose number is added."""
INTERRUPTED = 130
"""Ctrl-C; what was solved until then is written, films are not."""


def conclude(status: "Status", *, strict: bool) -> int:
    """Return the exit status of a command whose solve ended so; strict ones fail where not all that was asked holds."""
    from mapctl.problem.solution import Outcome  # not needed for --help

    if status.outcome is Outcome.INTERRUPTED:
        return INTERRUPTED
    return NOT_SATISFIED if strict and not status.ok else 0


_EXTRAS = {
    "render": {"pyrender", "trimesh", "OpenGL", "av", "PIL", "matplotlib"},
    "live": {"viser"},
    "usd": {"pxr"},
    "fbx": {"ufbx"},
    "stream": {"pythonosc"},
    "cluster": {"ray"},
    "mcp": {"mcp"},
}
"""Packages by the extra that installs them."""


def describe_error(error: Exception) -> str:
    """Describe an error that a command raises on purpose, or for a file or a package, in the line that is printed."""
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or str(error)).partition(".")[0]
        for extra, packages in _EXTRAS.items():
            if package in packages:
                return f"this needs the package {package}: pip install 'mapctl[{extra}]'"
        return f"this needs the package {package}, which is not installed"
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    return " ".join(str(error).split())


class Command:
    """Base of the frozen dataclasses of options; the function `run` beside them does the work."""

    def run(self) -> int:
        """Do the work and return the exit status; MapctlError for what is wrong with the request."""
        if not gc.isenabled():
            gc.freeze()
            gc.enable()
        return import_module(type(self).__module__).run(self)


@dataclass(frozen=True, kw_only=True)
class ModelCommand(Command):
    """Base of the options of commands that take bundled models."""

    prints_licence: ClassVar[bool] = True
    """Whether a line states the licence of the result: not where programs read standard output."""

    weights: options.MaybeWeights = None
    """Set of bundled models: full, or free, whose results may be used for anything. If not given, that of the file of
    the request, where it has one, else of the environment variable MAPCTL_WEIGHTS, else full."""

    def run(self) -> int:
        """Do the work with these weights, and tell the licence of its result."""
        from priors import weight_sets

        with weight_sets.use_weights(self.weights), weight_sets.record_licences() as used:
            weight_sets.find_current_set()  # an impossible one is refused now
            status = super().run()
        if used and self.prints_licence and not getattr(self, "quiet", False):
            print(f"licence   {weight_sets.format_licences(used)}")
        return status
