"""Output files appear whole or not at all: written beside their path, then renamed onto it."""

import errno
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path

from mapctl.errors import DiskFullError, WriteError


@contextmanager
def atomic_path(path: str | PathLike[str]) -> Iterator[Path]:
    """Yield an empty scratch file beside `path`, which becomes `path` when the block ends well.

    Whatever ends the block early (an error, a full disk, Ctrl-C) removes the scratch file and leaves an older `path`
    alone. The file has the permissions of the one that it replaces, a new one those that the umask allows, whoever
    wrote the scratch file. WriteError if the folder cannot be written, before the block runs where that can be known.
    """
    target = Path(os.path.realpath(path))
    scratch = target.with_name(f".{secrets.token_hex(4)}{target.suffix}")
    try:
        _check_target(path, target)
        scratch.touch(exist_ok=False)
        mode = _permissions(target if target.exists() else scratch)
        _set_permissions(
            scratch, mode | stat.S_IWUSR
        )  # from the beginning: what nobody may read is not shown in the meantime
        yield scratch
        with scratch.open("rb+") as file:  # flushed: a power cut could else leave an empty file under the final name
            os.fsync(file.fileno())
        _set_permissions(scratch, mode)
        scratch.replace(target)
    except OSError as error:
        raise _write_error(path, error) from error
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def write_bytes(path: str | PathLike[str], content: bytes) -> None:
    """Write `content` as the whole file `path`; WriteError if that cannot be."""
    with atomic_path(path) as scratch:
        scratch.write_bytes(content)


def write_text(path: str | PathLike[str], content: str) -> None:
    """Write `content` as UTF-8 with line feeds as they are; WriteError if that cannot be."""
    write_bytes(path, content.encode("utf-8"))


def check_writable(path: str | PathLike[str]) -> None:
    """Raise WriteError if `path` cannot be written; leave no trace. For use before long work."""
    target = Path(os.path.realpath(path))
    try:
        _check_target(path, target)
        with tempfile.NamedTemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise _write_error(path, error) from error


def check_folder(folder: str | PathLike[str]) -> None:
    """Raise WriteError unless the folder exists and can be written in, or can be made; leave no trace."""
    existing = Path(os.path.realpath(folder))
    while not existing.exists() and existing != existing.parent:  # a drive that is not there has no parent but itself
        existing = existing.parent
    if not existing.is_dir():
        raise WriteError(f"cannot write to {folder}: {existing} is not a folder")
    check_writable(existing / ".mapctl")


def _write_error(path: str | PathLike[str], error: OSError) -> WriteError:
    kind = DiskFullError if error.errno in (errno.ENOSPC, errno.EDQUOT) else WriteError
    return kind(f"cannot write {path}: {error.strerror or error}")


def _check_target(path: str | PathLike[str], target: Path) -> None:
    """Refuse folders and devices (/dev/null): renaming onto them would fail late or replace them."""
    if not os.fspath(path):
        raise WriteError("cannot write a file with an empty name")
    if not target.parent.is_dir():
        raise WriteError(f"cannot write {path}: the folder {target.parent} does not exist")
    if target.is_dir():
        raise WriteError(f"cannot write {path}: it is a folder")
    if target.exists() and not target.is_file():
        raise WriteError(f"cannot write {path}: it is not a regular file")


def _permissions(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def _set_permissions(scratch: Path, mode: int) -> None:
    """Set the file's mode: libraries that rename a file of their own (safetensors) leave it unreadable to others."""
    if _permissions(scratch) != mode:
        with suppress(PermissionError):  # file systems that know no permissions
            scratch.chmod(mode)
