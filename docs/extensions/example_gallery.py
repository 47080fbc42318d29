"""Order and pictures of the example gallery (sphinx-gallery, docs/gallery).

A script writes files as any program does, and runs in docs/gallery. Pictures and films that a block wrote are moved to
the page, under that block; what else a script has written is removed when it ends.
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
    "add_a_density",
)
_PICTURES = (".gif", ".png", ".webp")
_known: set[Path] = set()  # files that were there before a script began


class ReadingOrder:
    """Key by which sphinx-gallery sorts the scripts."""

    def __init__(self, folder: str): ...

    def __call__(self, script: str) -> int:
        """Return the index in ORDER."""
        return ORDER.index(Path(script).stem)


def tidy_up(gallery_conf: dict[str, Any], script: str | None, when: str) -> None:
    """Note the files in docs/gallery before a script runs, and remove new ones after it."""
    folder = Path(gallery_conf["src_dir"], gallery_conf["examples_dirs"])
    files = {path for path in folder.iterdir() if path.is_file()}
    if when == "before":
        _known.clear()
        _known.update(files)
        return
    for path in files - _known:
        path.unlink()


def show_pictures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Move the pictures that a block wrote to the page and return their reST; a still of a film is its thumbnail."""
    shown = []
    folder = Path(block_vars["src_file"]).parent
    written = [path for path in folder.iterdir() if path not in _known and path.suffix in _PICTURES]
    for path in sorted(written, key=lambda path: path.stat().st_mtime_ns):
        target = Path(next(block_vars["image_path_iterator"]))
        if path.suffix != ".png":
            with Image.open(path) as film:
                film.seek(round(0.6 * (film.n_frames - 1)))
                film.convert("RGB").save(target.with_suffix(".png"))
        moved = path.replace(target.with_suffix(path.suffix))
        shown.append(figure_rst([moved], gallery_conf["src_dir"], path.stem.replace("-", " ")))
    return "".join(shown)
