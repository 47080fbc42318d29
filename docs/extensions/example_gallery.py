"""What the example gallery (sphinx-gallery, docs/gallery) needs of code: the order of its pages, and files of scripts.

A script writes files as any program does, and runs in docs/gallery. Pictures and films that a block of code wrote are
moved to the page, under that block; what else a script has written is removed when it ends. So nothing stays in
docs/gallery, and a script reads as it would anywhere else.
"""

from pathlib import Path
from typing import Any

from PIL import Image
from sphinx_gallery.scrapers import figure_rst

ORDER = (
    "follow_a_curve",
    "direct_a_shot",
    "steer_from_a_loop",
    "clean_a_noisy_clip",
    "fill_a_gap",
    "tween_keys_seconds_apart",
    "vary_a_transition",
    "move_a_character",
    "add_a_term",
    "add_a_density",
    "search_with_a_swarm",
    "plot_training_curves",
)
"""Scripts as a reader meets them: jobs first, then parts of one's own."""
_PICTURES = (".gif", ".png", ".webp")
_SHOWN_AT = 0.6  # share of a film at which a thumbnail shows it: some way has been walked by then

_known: dict[Path, int] = {}
"""Files that were there before a script began, and when they were written."""


class ReadingOrder:
    """Key by which sphinx-gallery sorts the scripts."""

    def __init__(self, folder: str):
        """The folder is not needed, but it is told."""

    def __call__(self, script: str) -> int:
        """Return the script's place; ValueError where ORDER lacks it."""
        return ORDER.index(Path(script).stem)


def tidy_up(gallery_conf: dict[str, Any], script: str | None, when: str) -> None:
    """Note what is in docs/gallery before a script runs, and remove what it has left there after it."""
    folder = Path(gallery_conf["src_dir"], gallery_conf["examples_dirs"])
    if when == "before":
        _known.clear()
        _known.update({path: path.stat().st_mtime_ns for path in folder.iterdir()})
        return
    for path in _list_written(folder):
        path.unlink()


def show_pictures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Move pictures that a block of code wrote to the page, in the order in which they were written; return their reST.

    The text that stands for a picture is its file's name in words, `a-walk.webp` as "a walk". Of a film a still is put
    beside it, which the thumbnail is made of: a dozen films on one page are too much.
    """
    shown = []
    for path in _list_written(Path(block_vars["src_file"]).parent):
        if path.suffix not in _PICTURES:
            continue
        place = Path(next(block_vars["image_path_iterator"]))
        if path.suffix != ".png":
            _draw_still(path).save(place.with_suffix(".png"))
        moved = path.replace(place.with_suffix(path.suffix))
        shown.append(figure_rst([moved], gallery_conf["src_dir"], path.stem.replace("-", " ")))
    return "".join(shown)


def _list_written(folder: Path) -> list[Path]:
    """List files that the script has written, the oldest first."""
    files = [(path.stat().st_mtime_ns, path) for path in folder.iterdir() if path.is_file()]
    return [path for written, path in sorted(files) if _known.get(path) != written]


def _draw_still(film: Path) -> Image.Image:
    with Image.open(film) as pictures:
        pictures.seek(round(_SHOWN_AT * (pictures.n_frames - 1)))
        return pictures.convert("RGB")
