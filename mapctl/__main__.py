"""`python -m mapctl`, and what the command `mapctl` starts with: quiet about a Ctrl-C from the first import on."""

import sys

from mapctl.runtime import garbage


def main() -> int:
    """The command line with the words of the process; returns the exit status."""
    garbage.pause_collection()
    try:
        from mapctl.cli import main as command_line
    except KeyboardInterrupt:
        print("mapctl: interrupted", file=sys.stderr)
        return 130
    return command_line()


if __name__ == "__main__":
    sys.exit(main())
