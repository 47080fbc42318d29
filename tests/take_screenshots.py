"""Screenshots of the live viewer for docs/guides/live.md and for whoever changes how it looks.

    python tests/take_screenshots.py FOLDER [NAME ...]

starts `mapctl live` with one and with four characters, in both themes, and takes a picture of each at 700, 1280 and
1920 pixels; a NAME such as four-dark-1280 takes that one alone. All of them together are in sheet.jpg. It needs
Chromium and Playwright.
"""

import io
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from live_browser import COUNTED, Live, open_chromium
from PIL import Image

COUNTS = {"one": 1, "four": 4}
THEMES = ("light", "dark")
SIZES = {700: 620, 1280: 760, 1920: 1080}
SETTLE_SECONDS = 6.0
PUT_AWAY = """() => {
    for (const text of document.querySelectorAll("p"))
        if (/is too slow for this machine|more like this/.test(text.textContent)) text.remove();
}"""
MOST_BYTES = 250_000
SHEET_HEIGHT = 300  # pixels of a row


def list_names() -> Iterator[tuple[str, int, str, int]]:
    """Every picture: its name, number of characters, theme and width."""
    for word, count in COUNTS.items():
        for theme in THEMES:
            for width in SIZES:
                yield f"{word}-{theme}-{width}", count, theme, width


def shrink(png: bytes) -> bytes:
    """The picture as it is if that is small enough, else in 256 colours."""
    if len(png) <= MOST_BYTES:
        return png
    packed = io.BytesIO()
    flat = Image.open(io.BytesIO(png)).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    flat.save(packed, "PNG", optimize=True)
    return packed.getvalue()


def write_sheet(folder: Path) -> None:
    """All that were taken, small, those of a count and theme in a row."""
    rows = []
    for word in COUNTS:
        for theme in THEMES:
            paths = [folder / f"{word}-{theme}-{width}.png" for width in SIZES]
            rows.append([Image.open(path).convert("RGB") for path in paths if path.exists()])
    rows = [[one.resize((SHEET_HEIGHT * one.width // one.height, SHEET_HEIGHT)) for one in row] for row in rows if row]
    sheet = Image.new("RGB", (max(sum(one.width for one in row) for row in rows), SHEET_HEIGHT * len(rows)))
    for number, row in enumerate(rows):
        for k, one in enumerate(row):
            sheet.paste(one, (sum(before.width for before in row[:k]), number * SHEET_HEIGHT))
    sheet.save(folder / "sheet.jpg", quality=85)


def take(browser, live: Live, width: int) -> bytes:
    """A picture of the page, once its characters move. What is said of a machine without a graphics card, on which the
    browser takes the time of the characters, is put away."""
    page = browser.new_page(viewport={"width": width, "height": SIZES[width]})
    page.goto(live.url)
    page.get_by_text(COUNTED).wait_for(timeout=120_000)
    warning = page.get_by_text("Software WebGL rendering detected")
    if warning.count():
        warning.locator("xpath=following::button[1]").first.click()
    time.sleep(SETTLE_SECONDS)
    page.evaluate(PUT_AWAY)
    png = page.screenshot(timeout=120_000)
    page.close()
    return png


def main(folder: Path, names: list[str]) -> None:
    """Take all, or those that are named."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [one for one in list_names() if not names or one[0] in names]
    with open_chromium() as browser:
        for count, theme in dict.fromkeys((count, theme) for _, count, theme, _ in wanted):
            live = Live("--characters", count, "--theme", theme)
            try:
                for name, _, _, width in (one for one in wanted if one[1:3] == (count, theme)):
                    png = shrink(take(browser, live, width))
                    (folder / f"{name}.png").write_bytes(png)
                    print(f"{name}: {len(png) / 1000:.0f} kB{' - too large' * (len(png) > MOST_BYTES)}")
            finally:
                live.end()
    write_sheet(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
