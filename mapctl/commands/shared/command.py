"""Base of sub-commands: options that are cheap to import, and work that is imported when it runs."""

import gc
from dataclasses import dataclass
from importlib import import_module
from typing import ClassVar

from mapctl.commands.shared import options
from mapctl.commands.shared.threads import use_single_thread


class Command:
    """Base of the frozen dataclasses of options. A command's package holds them; its module `run` does the work."""

    work: ClassVar[str] = ""
    """Module whose `run` takes the options, where it is not `run` beside them."""
    single_thread: ClassVar[bool] = True
    """Whether one thread computes. One is fastest: on matrices this small two fight each other."""

    def run(self) -> int:
        """Do the work and return the exit status; MapctlError for what is wrong with the request."""
        if self.single_thread:
            use_single_thread()
        work = import_module(self.work or f"{type(self).__module__}.run")
        if not gc.isenabled():
            gc.freeze()
            gc.enable()
        return work.run(self)


@dataclass(frozen=True, kw_only=True)
class ModelCommand(Command):
    """Base of the options of commands that take bundled models."""

    tells_licence: ClassVar[bool] = True
    """Whether a line says under which licence the result was made: not where others read standard output."""

    weights: options.MaybeWeights = None
    """Set of bundled models: full, or free, whose results may be used for anything. If not given, that of the file of
    the request, where it says one, else of the environment variable MAPCTL_WEIGHTS, else full."""

    def run(self) -> int:
        """Do the work with these weights, and tell the licence of its result."""
        from priors import licences, weight_sets

        with weight_sets.use_weights(self.weights), licences.record_licences() as used:
            weight_sets.find_current_set()  # an impossible one is refused now
            status = super().run()
        if used and self.tells_licence and not getattr(self, "quiet", False):
            print(f"licence   {licences.format_licences(used)}")
        return status
