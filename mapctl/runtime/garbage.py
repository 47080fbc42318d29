"""Python's collector of garbage, kept off the half a million objects that a command imports and never gives back.

It would go over them again and again, while they are imported and thrice when the process ends: a third of the time of
a short command.
"""

import atexit
import gc

_paused = False


def pause_collection() -> None:
    """Pause the collector of a process that begins to import; and let its end leave all memory to the system."""
    global _paused
    _paused = gc.isenabled()
    gc.disable()
    atexit.register(gc.freeze)


def resume_collection() -> None:
    """Collect again, but for what there is now, where it was paused; call it once all is imported."""
    global _paused
    if _paused:
        gc.freeze()
        gc.enable()
        _paused = False
