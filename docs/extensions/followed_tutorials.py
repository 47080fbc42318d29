"""Follow each tutorial before the site is built, so that its pictures are those of its steps.

The fenced blocks of docs/tutorials/NAME.md run in order, in an empty folder: ```sh by a shell, ```python by one
interpreter a block. A step that fails ends the build. Pictures are kept in `made/NAME`, which the page shows, and made
again when the text or the version of mapctl changes.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from mapctl import __version__

_PICTURES = (".png", ".gif", ".jpg", ".webp")
_STEP = re.compile(r"^```(sh|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def _follow(page: Path, folder: str) -> None:
    environment = dict(os.environ, PATH=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    for number, (language, step) in enumerate(_STEP.findall(page.read_text("utf-8")), start=1):
        words = ["sh", "-eu"] if language == "sh" else [sys.executable, "-"]
        done = subprocess.run(words, input=step, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            raise ExtensionError(f"{page.name}, step {number}, ended with {done.returncode}:\n{done.stderr[-2000:]}")


def _keep_pictures(page: Path) -> None:
    kept = page.parent / "made" / page.stem
    stamp, state = kept / ".followed", hashlib.sha256((page.read_text("utf-8") + __version__).encode()).hexdigest()
    if stamp.exists() and stamp.read_text() == state:
        return
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    with TemporaryDirectory() as folder:
        _follow(page, folder)
        for picture in Path(folder).rglob("*"):
            if picture.suffix in _PICTURES:
                shutil.copy(picture, kept)
    stamp.write_text(state)


def _follow_all(app: Sphinx) -> None:
    with ThreadPoolExecutor(max_workers=2) as pool:
        list(pool.map(_keep_pictures, sorted(Path(app.srcdir, "tutorials").glob("*.md"))))


def setup(app: Sphinx) -> dict[str, bool]:
    """Follow the tutorials before pages are read."""
    app.connect("builder-inited", _follow_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
