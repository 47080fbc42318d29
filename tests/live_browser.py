"""A browser for the live viewer, and the viewer as a user starts it."""

import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
COUNTED = re.compile(r"\d+ of \d+ frames late")  # in the page once characters move
SIZE = {"width": 760, "height": 620}  # small: these machines draw without a graphics card
SWITCHES = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _hear_ctrl_c() -> None:
    """Shells let what they start in the background ignore Ctrl-C, and its children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Live:
    """`mapctl live` as a user starts it."""

    def __init__(self, *words: object, port: int | None = None):
        self.port = port or free_port()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mapctl.cli", "live", "--port", str(self.port), *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=_hear_ctrl_c,
        )
        self.lines: list[str] = []
        assert self.process.stdout is not None
        while not any("open http" in line for line in self.lines):
            line = self.process.stdout.readline()
            assert line, "".join(self.lines)
            self.lines.append(line)
        self.url = re.search(r"http://\S+", self.lines[-1]).group()
        threading.Thread(target=lambda: self.lines.extend(self.process.stdout), daemon=True).start()

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(timeout=20)
        finally:
            self.process.kill()


@contextmanager
def open_chromium() -> Iterator[Any]:
    """A browser that draws without a graphics card."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as drivers:
        opened = drivers.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield opened
        opened.close()
