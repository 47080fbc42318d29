"""docs/guides/weights.md lists the models of both sets as they are, and nothing else."""

import json
import re

import pages
import pytest

from mapctl.features import PRIOR_FPS
from priors import weight_sets


def describe(name: str, weights: str) -> str:
    """What the page says of a model of a set: its size, and what it was trained on, by its card; or what stands in."""
    path = weight_sets.find_file(f"{weights}/{name}")
    if path is None:
        return "-"
    if path.stem != name:
        return f"`{path.stem}` serves"
    data = json.loads(path.with_suffix(".json").read_text("utf-8"))["data"]
    size = f"{path.stat().st_size / 1e6:.1f} MB"
    if "frames" not in data:
        return size
    return f"{size}; {int(data['clips']):,} clips, {int(data['frames']) / PRIOR_FPS / 60:.0f} min"


def test_the_table_of_models_is_that_of_the_bundled_files(monkeypatch):
    monkeypatch.delenv(weight_sets.FOLDER_VARIABLE, raising=False)
    page = pages.read_page("docs/guides/weights.md")
    rows = re.findall(r"^\| `([\w-]+)` \| [^|]+ \| ([^|]+) \| ([^|]+) \|$", page, re.M)
    listed = {name: (full, free) for name, full, free in rows if name not in weight_sets.SETS}
    bundled = {*weight_sets.list_models("full"), *weight_sets.list_models("free")}
    wanted = {name: (describe(name, "full"), describe(name, "free")) for name in sorted(bundled)}
    assert listed == wanted


@pytest.mark.parametrize("weights", weight_sets.SETS)
def test_every_model_has_its_card(weights, monkeypatch):
    monkeypatch.delenv(weight_sets.FOLDER_VARIABLE, raising=False)
    for name in weight_sets.list_models(weights):
        path = weight_sets.find_file(f"{weights}/{name}")
        assert path is not None
        assert path.with_suffix(".json").is_file()
