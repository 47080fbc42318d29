"""The few exceptions mapctl raises on purpose; each message is one line: what was wrong, where, what is allowed."""

from os import PathLike

_LONGEST = 500  # letters of a message about a file


class MapctlError(Exception):
    """Base of everything the command line reports with exit status 2."""


class FileFormatError(MapctlError):
    """A file that cannot be read for what it claims to be: `path`, what is wrong, and the number of the `line`, from 1,
    where there is one. The message is cut where it quotes too much of the file."""

    def __init__(self, path: str | PathLike[str], message: str, line: int | None = None):
        where = f"{path}, line {line}" if line is not None else f"{path}"
        super().__init__(f"{where}: {message if len(message) <= _LONGEST else f'{message[:_LONGEST]}...'}")
        self.path, self.line = path, line


class RequestError(MapctlError):
    """A request, option or argument that cannot be."""


class WriteError(RequestError):
    """A path that cannot be written, or a disk that is full."""


class DiskFullError(WriteError):
    """No space left, or none for this user: what writes many files can as well stop."""


class CheckpointError(MapctlError):
    """Weights or a training run that do not fit this code."""
