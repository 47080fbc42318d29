"""The live viewer in a real browser: the page loads, controls move the character, a drawn path is walked, a recording
comes down as a file that can be read."""

import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import mapctl

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
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; .ci/setup browser says how to get it")


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
def open_page(show: Live, **device: Any) -> Iterator[Any]:
    """The page in a browser that draws without a graphics card, once its characters move; no script of it may fail."""
    from playwright.sync_api import sync_playwright

    faults = []
    try:
        with sync_playwright() as drivers:
            browser = drivers.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
            page = browser.new_page(**{"viewport": SIZE, "accept_downloads": True} | device)
            page.on("pageerror", lambda error: faults.append(str(error)))
            page.goto(show.url)
            page.get_by_text(COUNTED).wait_for(timeout=60_000, state="attached")  # a phone's panel is folded
            yield page
            browser.close()
    except BaseException:
        show.end()  # else its characters go on
        raise
    assert faults == []


def number(page, label: str):
    """The field beside a slider; the tab with it is open."""
    row = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input[@type='text']][1]")
    return row.locator("input[type='text']").first


def shows(page, label: str, expected: Callable[[float], bool]) -> bool:
    """Whether a slider comes to show what is expected within 20 s; a page that draws without a graphics card is
    slow."""
    for _ in range(200):
        text = number(page, label).input_value()
        if text and expected(float(text)):
            return True
        time.sleep(0.1)
    return False


def open_tab(page, name: str) -> None:
    page.get_by_text(name, exact=True).first.click()


def recorded(page, tmp_path, seconds: float) -> mapctl.Motion:
    open_tab(page, "Play")
    page.get_by_role("button", name="Record", exact=True).click()
    page.get_by_role("button", name="Stop and save").wait_for()
    time.sleep(seconds)
    with page.expect_download(timeout=60_000) as coming:
        page.get_by_role("button", name="Stop and save").click()
    path = tmp_path / coming.value.suggested_filename
    coming.value.save_as(path)
    return mapctl.load(path)


@pytest.mark.slow
def test_a_walk_through_the_page(tmp_path):
    show = Live()
    with open_page(show) as page:
        open_tab(page, "Steer")
        number(page, "Speed, m/s").click()
        page.keyboard.press("Control+a")
        page.keyboard.type("1.1")  # as people do: what is put in at once is lost where the server has just moved it
        page.keyboard.press("Enter")
        assert shows(page, "Speed, m/s", lambda value: value == 1.1)
        page.mouse.click(150, 500)  # the scene, so that keys are not typed into a field
        page.keyboard.down("w")
        assert shows(page, "Heading, degrees", bool), "as the camera sees it, which looks past the character"
        page.keyboard.up("w")
        assert shows(page, "Speed, m/s", lambda value: value == 0)
        open_tab(page, "Path")
        draw = page.get_by_text("Draw by clicking on the ground")
        draw.locator("xpath=following::input[@type='checkbox'][1]").check()
        for x, y in ((250, 400), (120, 450), (60, 380)):
            page.mouse.click(x, y)
            time.sleep(0.7)
        page.get_by_text("3 points").wait_for(timeout=20_000)
        page.get_by_role("button", name="Walk it").click()
        walked = recorded(page, tmp_path, 2)
        assert walked.skeleton.names[0] == "hips"
        assert walked.num_frames >= 30
        assert float((walked.root_position[-1] - walked.root_position[0])[::2].norm()) > 0.5
        page.get_by_role("button", name="Replay").click()
        page.get_by_text("The characters wait").wait_for(timeout=20_000)
        page.get_by_role("button", name="Back to live").click()
    assert not any("Traceback" in line or "went wrong" in line for line in show.lines), show.lines
    assert show.end() == 0


@pytest.mark.slow
def test_a_phone_steers_by_touch(prior):
    show = Live("--prior", prior)
    with open_page(show, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True) as page:
        speed = page.get_by_text("Speed, m/s", exact=True)
        speed.wait_for(state="hidden", timeout=20_000)
        inside = "() => [...document.querySelectorAll('#mapctl-touch > *')].every((one) => {"
        inside += "const r = one.getBoundingClientRect(); return r.left >= 0 && r.right <= 390 && r.bottom <= 844; })"
        assert page.evaluate(inside)
        page.locator("#mapctl-run").evaluate("one => one.click()")
        stick = page.locator("#mapctl-move").bounding_box()
        x, y = stick["x"] + stick["width"] / 2, stick["y"] + stick["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 50, y)
        page.get_by_text("mapctl live").last.evaluate("one => one.click()")
        speed.wait_for(timeout=20_000)
        assert shows(page, "Speed, m/s", lambda value: value > 1.3), "faster than a walk"
        assert shows(page, "Heading, degrees", bool)
        page.mouse.up()
        assert shows(page, "Speed, m/s", lambda value: value == 0)
    assert show.end() == 0
