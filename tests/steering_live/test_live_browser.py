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
from collections.abc import Iterator
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
def open_chromium() -> Iterator[Any]:
    """A browser that draws without a graphics card."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as drivers:
        opened = drivers.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def live(prior):
    show = Live("--prior", prior)
    yield show
    assert show.end() == 0


@pytest.fixture(scope="module")
def browser():
    with open_chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def page(browser, live):
    opened = browser.new_page(viewport=SIZE, accept_downloads=True)
    opened.add_init_script(GAMEPADS)
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.goto(live.url)
    opened.get_by_text(COUNTED).wait_for(timeout=60_000)
    yield opened
    opened.close()
    assert faults == []


def number(page, label: str):
    """The field beside a slider; the tab with it is open."""
    row = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input[@type='text']][1]")
    return row.locator("input[type='text']").first


def put(page, label: str, value: float) -> None:
    open_tab(page, "Steer")
    field = number(page, label)
    field.fill(str(value))
    field.press("Enter")


def shows(page, label: str, value: float) -> bool:
    """Whether a slider comes to show a value within 20 s; a page that draws without a graphics card is slow."""
    for _ in range(200):
        if number(page, label).input_value() not in ("", None) and float(number(page, label).input_value()) == value:
            return True
        time.sleep(0.1)
    return False


PLUG_IN = """axes => { window.plugged = {
    connected: true, axes: [...axes, 0, 0], buttons: Array(17).fill({value: 0}),
}; }"""
GAMEPADS = "window.plugged = null; navigator.getGamepads = () => [window.plugged];"


def differs(page, label: str, value: float) -> bool:
    """Whether a slider comes to show another value within 20 s."""
    return any(time.sleep(0.1) or float(number(page, label).input_value() or value) != value for _ in range(200))


def open_tab(page, name: str) -> None:
    page.get_by_text(name, exact=True).first.click()


def recorded(page, tmp_path, seconds: float, during=lambda: None) -> mapctl.Motion:
    open_tab(page, "Play")
    page.get_by_role("button", name="Record", exact=True).click()
    page.get_by_role("button", name="Stop and save").wait_for()
    during()
    open_tab(page, "Play")
    time.sleep(seconds)
    with page.expect_download(timeout=60_000) as coming:
        page.get_by_role("button", name="Stop and save").click()
    path = tmp_path / coming.value.suggested_filename
    coming.value.save_as(path)
    return mapctl.load(path)


def speed_of(motion: mapctl.Motion) -> float:
    way = motion.root_position[:, ::2]
    return float((way[-1] - way[0]).norm()) * float(motion.fps) / (len(way) - 1)


@pytest.mark.slow
def test_a_slider_and_keys_move_the_character_and_the_recording_shows_it(page, tmp_path):
    put(page, "Speed, m/s", 0)
    time.sleep(2)
    assert speed_of(recorded(page, tmp_path, 1.5)) < 0.35
    put(page, "Speed, m/s", 1.2)
    time.sleep(2)
    walked = recorded(page, tmp_path, 2)
    assert walked.skeleton.names[0] == "hips"
    assert walked.num_frames >= 30
    assert speed_of(walked) > 0.7
    open_tab(page, "Steer")
    page.mouse.click(150, 500)  # the scene, so that keys are not typed into a field
    page.keyboard.press("x")
    assert shows(page, "Speed, m/s", 0)


def test_a_held_key_walks_away_from_the_camera_and_a_stick_that_is_unplugged_stands(page):
    open_tab(page, "Steer")
    number(page, "Speed, m/s").click()
    page.keyboard.press("Control+a")
    page.keyboard.type("1.1")  # as people do: what is put in at once is lost where the server has just moved the slider
    page.keyboard.press("Enter")
    assert shows(page, "Speed, m/s", 1.1)
    page.mouse.click(150, 500)
    try:
        page.keyboard.down("w")
        assert differs(page, "Heading, degrees", 0.0), "as the camera sees it, which looks past the character"
        page.keyboard.up("w")
        assert shows(page, "Speed, m/s", 0)
        page.evaluate(PLUG_IN, [1.0, 0.0])
        assert differs(page, "Speed, m/s", 0.0)
    finally:
        page.keyboard.up("w")
        page.evaluate("window.plugged = null")
    page.get_by_text("unplugged; the character stands").wait_for(timeout=20_000)
    assert shows(page, "Speed, m/s", 0)
    page.keyboard.press("h")
    page.get_by_text("bring all characters into view").wait_for()
    page.keyboard.press("h")
    page.get_by_role("button", name="Reset").click()


def walk_path(page) -> None:
    open_tab(page, "Path")
    page.get_by_role("button", name="Walk it").click()


@pytest.mark.slow
def test_a_drawn_path_is_walked(page, tmp_path):
    page.get_by_role("button", name="Reset").click()
    box = page.get_by_text("Draw by clicking on the ground").locator("xpath=following::input[@type='checkbox'][1]")
    put(page, "Speed, m/s", 0)
    page.get_by_role("button", name="Reset").click()
    open_tab(page, "Path")
    box.check()
    for x, y in ((250, 400), (120, 450), (60, 380)):
        page.mouse.click(x, y)
        time.sleep(0.7)
    walked = recorded(page, tmp_path, 4, during=lambda: walk_path(page))
    way = walked.root_position[:, ::2]
    assert float((way[-1] - way[0]).norm()) > 0.5
    open_tab(page, "Path")
    box.uncheck()
    page.get_by_role("button", name="Clear").click()


FIELDS = ("Speed, m/s", "Heading, degrees", "Facing, degrees", "Step length, m")
TYPED = ("", "-", "-5", "abc", "1e9", "0.8", "99", "00.30", "1,5", "٣", "9" * 40)


def type_into(page, label: str, text: str) -> None:
    """Key by key, as people do, and then on to the next field or not."""
    field = number(page, label)
    field.focus()
    field.press("Control+a")
    field.press("Delete")
    for key in text:
        field.press(key) if key.isascii() else field.type(key)
        page.wait_for_timeout(40)
    if len(text) % 2:
        field.press("Tab")


def check(page, label: str) -> None:
    """Set a box, or leave it set."""
    page.get_by_text(label, exact=True).locator("xpath=following::input[@type='checkbox'][1]").check(force=True)


@pytest.mark.timeout(1200)
@pytest.mark.slow
def test_whatever_is_typed_it_goes_on_and_the_recording_is_whole(page, live, tmp_path):
    page.get_by_role("button", name="Reset").click()

    def during() -> None:
        open_tab(page, "Steer")
        for box in ("Measured steps", "Face a fixed direction"):
            check(page, box)
        for number, text in enumerate(TYPED):
            type_into(page, FIELDS[number % len(FIELDS)], text)

    time.sleep(2)  # until the page counts anew
    began = shown(page)
    motion = recorded(page, tmp_path, 1.0, during=during)
    count = shown(page) - began
    assert live.process.poll() is None
    assert not any("Traceback" in line or "went wrong" in line or "ended" in line for line in live.lines), live.lines
    assert abs(motion.num_frames - count) < 150, "all from the button's first press to its second, as the page counts"
    assert float(motion.root_position.diff(dim=0).norm(dim=-1).max()) < 0.5, "none is missing in between"
    open_tab(page, "Steer")
    type_into(page, "Speed, m/s", "0.7")
    assert shows(page, "Speed, m/s", 0.7), "it still obeys"


def shown(page) -> int:
    """Frames that were shown since the last reset, as the page says."""
    return int(re.search(r"of (\d+) frames", page.inner_text("body")).group(1))
