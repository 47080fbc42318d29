"""Base of sub-commands: options that are cheap to import, and work that is imported when it runs."""

from importlib import import_module
from typing import ClassVar

from mapctl.commands.shared.threads import use_single_thread
from mapctl.runtime import garbage


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
        garbage.resume_collection()
        return work.run(self)
