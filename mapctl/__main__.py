"""`python -m mapctl`, and what the command `mapctl` starts with: quiet about a Ctrl-C from the first import on."""

import atexit
import gc
import io
import sys


def main() -> int:
    """The command line with the words of the process; returns the exit status."""
    gc.disable()  # until all is imported: a third of the time of a short command, for objects that are never given back
    atexit.register(gc.freeze)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # What goes into a file or a pipe has the system's encoding, on Windows one without most of the world's letters.
        sys.stdout.reconfigure(errors="replace")
    try:
        from mapctl.cli import main as command_line
    except KeyboardInterrupt:
        print("mapctl: interrupted", file=sys.stderr)
        return 130
    return command_line()


if __name__ == "__main__":
    sys.exit(main())
