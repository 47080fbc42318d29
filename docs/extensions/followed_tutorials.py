"""Follow each tutorial before the site is built, so that its pictures are those of its steps.

Pictures are kept in `made/NAME`, which the page shows; a new text or version of mapctl writes them again.
"""

import hashlib
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

from sphinx.application import Sphinx

from mapctl import __version__

_PICTURES = (".png", ".gif", ".jpg", ".webp")
_BLOCK = re.compile(r"^```(sh|python|text)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_COMMAND = f'mapctl() {{ "{sys.executable}" -m mapctl "$@"; }}\n'
_NOT_HELD = ("NOT HELD", "the constraints cannot all hold")


def follow(page: Path, folder: str | Path) -> None:
    """Run the fenced blocks of a page in order, ```sh by a shell and ```python by one interpreter a block; or a script.

    RuntimeError for one that fails, and for a request that is not held unless the next block, ```text, shows that.
    """
    text = page.read_text("utf-8")
    blocks = [("python", text)] if page.suffix == ".py" else _BLOCK.findall(text)
    for (language, block), (_, shown) in pairwise([*blocks, ("", "")]):
        if language == "text":
            continue
        words, block = (["sh", "-eu"], _COMMAND + block) if language == "sh" else ([sys.executable, "-"], block)
        done = subprocess.run(
            words, input=block, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        if done.returncode or any(mark in done.stdout and mark not in shown for mark in _NOT_HELD):
            raise RuntimeError(f"{page.name}, exit status {done.returncode}:\n{block}\n{done.stdout[-2000:]}")


def _keep_pictures(page: Path) -> None:
    kept = page.parent / "made" / page.stem
    stamp, state = kept / ".followed", hashlib.sha256((page.read_text("utf-8") + __version__).encode()).hexdigest()
    if stamp.exists() and stamp.read_text() == state:
        return
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    with TemporaryDirectory() as folder:
        follow(page, folder)
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
