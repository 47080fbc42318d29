"""A live page for as long as one likes, with a browser that does anything at random: what breaks, comes late or grows.

`python tests/live_soak.py` runs for MAPCTL_SOAK_MINUTES (30) and prints memory over time; words go to `mapctl live`.
"""

import os
import random
import re
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from live_browser import COUNTED, SIZE, Live, open_chromium
from playwright.sync_api import Browser, Error, Page

from mapctl.runtime.memory import measure_memory_mb

MINUTES = "MAPCTL_SOAK_MINUTES"
LONG_MINUTES = 12.0  # from which on memory is held to MAX_GROWTH_MB: before, caches and the last two minutes still fill
MAX_GROWTH_MB, MAX_SHORT_GROWTH_MB = 5.0, 60.0
MAX_LATE_SHARE = 0.01
_FIRST_SHARE = 1 / 6  # of the time, which is not looked at: five minutes of half an hour
_SAMPLES = 30
_PATIENCE_MS = 1500
_TABS = ("Steer", "Path", "Reach", "Play", "Terms", "View")
_TYPED = ("", "-", "1.2", "0", "99", "abc", "-40", "1e9", "3", "0.5")
_KEYS = ("w", "a", "s", "d", "x", "b", "g", "c", "h", "r", "ArrowUp")
_BUTTONS = {
    "": ("Reset", "Pause", "Go on"),
    "Path": ("Walk it", "Insert a point", "Remove the point", "Clear", "Download CSV"),
    "Reach": ("Bring them here",),
    "Play": ("Replay", "Back to live"),
    "Terms": ("Reset the sigmas",),
    "View": ("Show all",),
}
"""Buttons by the tab that holds them; the first are above the tabs."""
_RECORD = ("Record", "Record", "Stop and save", "Break off", "Save again")


@dataclass
class SoakReport:
    """What came of it."""

    memory_mb: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    """Minutes, and memory by process."""
    actions: dict[str, int] = field(default_factory=dict)
    """How often each was done."""
    late: int = 0
    frames: int = 0
    faults: list[str] = field(default_factory=list)
    """Lines of the server that no page may bring about."""
    status: int | None = None
    """Exit status of mapctl live."""

    @property
    def late_share(self) -> float:
        """Share of frames that came late, as the page counts them."""
        return self.late / max(1, self.frames)

    def growth_mb(self) -> dict[str, float]:
        """Growth of each process from the end of the first part: means of the first and of the last third after it."""
        rows = [row for at, row in self.memory_mb if at >= _FIRST_SHARE * self.memory_mb[-1][0]]
        third = max(1, len(rows) // 3)

        def mean(part: list[dict[str, float]], name: str) -> float:
            found = [row[name] for row in part if name in row]
            return sum(found) / max(1, len(found))

        return {
            name: mean(rows[-third:], name) - mean(rows[:third], name)
            for name in rows[-1]
            if any(name in row for row in rows[:third])
        }

    def table(self) -> str:
        """Format memory over time."""
        names = sorted({name for _, row in self.memory_mb for name in row})
        lines = ["minutes " + " ".join(f"{name:>14}" for name in names)]
        lines += [
            f"{at:7.1f} " + " ".join(f"{row.get(name, float('nan')):11.1f} MB" for name in names)
            for at, row in self.memory_mb
        ]
        return "\n".join(lines)


class Visitor:
    """A browser whose user does anything."""

    def __init__(self, browser: Browser, url: str, report: SoakReport, seed: int):
        self._browser, self._url, self._report, self._random = browser, url, report, random.Random(seed)
        self._counted = (0, 0)
        self.page = self._open()

    def act(self) -> None:
        """Do one thing; what cannot be done just now (a button that is not shown) is passed over."""
        actions: dict[str, tuple[int, Callable[[], None]]] = {
            "type": (6, self._type),
            "key": (6, self._press_key),
            "click": (6, self._click_ground),
            "drag": (4, self._drag),
            "check": (4, self._check),
            "button": (8, self._press_any),
            "record": (4, lambda: self._press("Play", self._random.choice(_RECORD))),
            "tab": (6, lambda: self._press_tab(self._random.choice(_TABS))),
            "reload": (1, self._reload),
            "vanish": (1, self._vanish),
        }
        name = self._random.choices(list(actions), [weight for weight, _ in actions.values()])[0]
        try:
            actions[name][1]()
            self._report.actions[name] = self._report.actions.get(name, 0) + 1
        except Error:
            self._report.actions["not possible"] = self._report.actions.get("not possible", 0) + 1

    def count(self) -> None:
        """Add the frames that the page has counted since the last time; a reset lets it count anew."""
        try:
            found = COUNTED.search(self.page.inner_text("body"))
        except Error:
            return
        if found is None:
            return
        late, frames = (int(number) for number in re.findall(r"\d+", found.group()))
        before = self._counted if frames >= self._counted[1] else (0, 0)
        self._report.late += max(0, late - before[0])
        self._report.frames += frames - before[1]
        self._counted = late, frames

    def _open(self) -> Page:
        page = self._browser.new_page(viewport=SIZE, accept_downloads=True)
        page.set_default_timeout(_PATIENCE_MS)
        page.on("pageerror", lambda error: self._report.faults.append(f"page: {error}"))
        page.goto(self._url, timeout=60_000)
        page.get_by_text(COUNTED).wait_for(timeout=120_000)
        return page

    def _place(self) -> tuple[float, float]:
        return self._random.uniform(20, 0.45 * SIZE["width"]), self._random.uniform(150, SIZE["height"] - 60)

    def _type(self) -> None:
        fields = self.page.locator("input[type='text']:visible").all()
        if not fields:
            return
        chosen = self._random.choice(fields)
        chosen.fill(self._random.choice(_TYPED))
        chosen.press("Enter")

    def _press_key(self) -> None:
        self.page.mouse.move(*self._place())
        self.page.keyboard.press(self._random.choice(_KEYS))

    def _click_ground(self) -> None:
        self.page.mouse.click(*self._place())

    def _drag(self) -> None:
        self.page.mouse.move(*self._place())
        self.page.mouse.down()
        self.page.mouse.move(*self._place(), steps=5)
        self.page.mouse.up()

    def _check(self) -> None:
        boxes = self.page.locator("input[type='checkbox']:visible").all()
        if boxes:
            self._random.choice(boxes).click(force=True)

    def _press_any(self) -> None:
        tab = self._random.choice(list(_BUTTONS))
        self._press(tab, self._random.choice(_BUTTONS[tab]))

    def _press(self, tab: str, name: str) -> None:
        if tab:
            self._press_tab(tab)
        self.page.get_by_role("button", name=name, exact=True).click(timeout=500)

    def _press_tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click(timeout=500)

    def _reload(self) -> None:
        self.page.reload(timeout=60_000)
        self.page.get_by_text(COUNTED).wait_for(timeout=120_000)

    def _vanish(self) -> None:
        """Go away, sometimes just after a file was asked for, and come back."""
        if self._random.random() < 0.5:
            with suppress(Error):
                self._press("Play", self._random.choice(("Stop and save", "Save again")))
        self.page.close()
        time.sleep(self._random.uniform(0, 4))
        self.page = self._open()


def soak(
    minutes: float, *words: object, seed: int = 0, idle: bool = False, tell: Callable[[str], None] = print
) -> SoakReport:
    """Run `mapctl live` with these words, with a visitor, for some minutes; `idle` as in `open_chromium`."""
    report, live = SoakReport(), Live(*words)
    try:
        with open_chromium(idle=idle) as browser:
            visitor = Visitor(browser, live.url, report, seed)
            began, next_sample = time.monotonic(), 0.0
            while (gone := (time.monotonic() - began) / 60) < minutes and live.process.poll() is None:
                visitor.act()
                visitor.count()
                if gone >= next_sample:
                    next_sample += minutes / _SAMPLES
                    report.memory_mb.append((gone, measure_processes(live.process.pid)))
                    tell(f"{gone:5.1f} min, {report.frames} frames, {report.late} late, {report.memory_mb[-1][1]}")
                time.sleep(0.1)
    finally:
        report.status = live.end()
    report.faults += [line for line in live.lines if re.search("Traceback|went wrong|no more|Error", line)]
    return report


def measure_processes(pid: int) -> dict[str, float]:
    """Measure the memory of a process and of those that it started, MB, by their kind and number."""
    found, waiting = {"server": round(measure_memory_mb(pid), 1)}, [(pid, "")]
    while waiting:
        parent, name = waiting.pop(0)
        for number, child in enumerate(_list_children(parent), start=1):
            own = f"{name}{'.' if name else 'child '}{number}"
            memory = measure_memory_mb(child)
            if memory == memory:  # it may have ended just now
                found[own] = round(memory, 1)
            waiting.append((child, own))
    return found


def _list_children(pid: int) -> list[int]:
    """List the processes that a process started, by age, but for films and files that are made: they come and go."""
    try:
        text = " ".join(path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children"))
        found = sorted(int(word) for word in text.split())
        return [child for child in found if b"spawn_main" not in Path(f"/proc/{child}/cmdline").read_bytes()]
    except OSError:
        return []


def list_failures(report: SoakReport, minutes: float) -> list[str]:
    """List what must not be, in sentences."""
    most = MAX_GROWTH_MB if minutes >= LONG_MINUTES else MAX_SHORT_GROWTH_MB
    grown = {name: round(grown, 1) for name, grown in report.growth_mb().items() if grown > most}
    failures = [f"the server or a page said: {line.strip()}" for line in report.faults]
    failures += [f"memory grew by more than {most:g} MB: {grown}"] if grown else []
    failures += [f"the exit status is {report.status}"] if report.status != 0 else []
    return failures


def main() -> int:
    """Run, and print what came of it."""
    minutes = float(os.environ.get(MINUTES, "30"))
    report = soak(minutes, *sys.argv[1:], idle=True)
    failures = list_failures(report, minutes)
    if report.late_share > MAX_LATE_SHARE:
        failures.append(f"{100 * report.late_share:.1f} % of the frames were late")
    print(report.table())
    print(f"{report.actions}")
    print(f"{report.frames} frames, {100 * report.late_share:.2f} % late; growth in MB: {report.growth_mb()}")
    print("\n".join(failures) or "nothing broke")
    return len(failures) > 0


if __name__ == "__main__":
    raise SystemExit(main())
