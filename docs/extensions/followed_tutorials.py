"""Follows each tutorial literally before the site is built, so that its pictures are those that its steps make.

The fenced blocks of docs/tutorials/NAME.md are done in the order in which they stand, in an empty folder: ```sh by a
shell, ```python by one interpreter a block. A step that fails ends the build. Pictures are shown from
`made/NAME/FILE`, where the folder's pictures are put; a tutorial that shows one which no step made fails, too.

A tutorial is followed anew when its text or the version of mapctl changes, or after `make clean`.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging

from mapctl import __version__

PICTURES = (".png", ".gif", ".jpg", ".webp")
_STEP = re.compile(r"^```(sh|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_log = logging.getLogger(__name__)


class Step(NamedTuple):
    """A block that a reader types or saves and runs."""

    language: str
    """`sh` or `python`."""
    text: str
    """Its lines."""


def read_steps(page: Path) -> Iterator[Step]:
    """The steps of a page, in order."""
    return (Step(*found) for found in _STEP.findall(page.read_text("utf-8")))


def follow(page: Path, folder: Path, python: str = sys.executable, env: Mapping[str, str] = os.environ) -> None:
    """Do a page's steps in a folder, by the interpreter of an environment where mapctl is installed; ExtensionError
    names the first one that fails."""
    # Commands are typed as `mapctl`, which lies beside the interpreter.
    environment = dict(env, PATH=os.pathsep.join([str(Path(python).parent), env.get("PATH", "")]))
    for number, step in enumerate(read_steps(page), start=1):
        words = ["sh", "-eu"] if step.language == "sh" else [python, "-"]
        done = subprocess.run(words, input=step.text, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            raise ExtensionError(f"{page.name}, step {number}, ended with {done.returncode}:\n{done.stderr[-2000:]}")


def follow_all(app: Sphinx) -> None:
    """Follow the tutorials whose pictures are not up to date, two at a time."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        for done in [
            pool.submit(_make_pictures, page) for page in sorted((Path(app.srcdir) / "tutorials").glob("*.md"))
        ]:
            done.result()


def _make_pictures(page: Path) -> None:
    """Follow a tutorial unless its pictures are up to date, and keep them."""
    if not any(read_steps(page)):
        return
    made = page.parent / "made" / page.stem
    stamp, state = made / ".followed", hashlib.sha256((page.read_text("utf-8") + __version__).encode()).hexdigest()
    if stamp.exists() and stamp.read_text() == state:
        return
    _log.info("following %s", page.name)
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    with TemporaryDirectory() as folder:
        follow(page, Path(folder))
        for picture in sorted(Path(folder).rglob("*")):
            if picture.suffix in PICTURES:
                shutil.copy(picture, made / picture.name)
    stamp.write_text(state)


def setup(app: Sphinx) -> dict[str, bool]:
    """Follow the tutorials before pages are read."""
    app.connect("builder-inited", follow_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
