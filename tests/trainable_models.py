"""Every model that can be trained, by settings of six steps that are validated at every other."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import tiny_denoiser
import tiny_infiller
import tiny_path
import tiny_stitcher
import tiny_transformer
import tiny_tweener

from mapctl.commands.train import RECIPES, load_recipe
from priors.lstm_gmm.network import LstmGmmConfig
from priors.refiner import RefinerConfig

_WINDOWS = {"batch": 3, "window": 32}
_SMALL: dict[str, dict[str, Any]] = {
    "lstm-gmm": {"batch": 4, "window": 20, "shape": LstmGmmConfig(width=8, components=2)},
    "refiner": {
        **{"window": 10, "batch": 160, "report_steps": 2},
        "shape": RefinerConfig(width=6, memory=5, lookahead=1, joints=("hips", "rightToes")),
    },
    "denoiser": {**_WINDOWS, "shape": tiny_denoiser.CONFIG},
    "pose-transformer": {**_WINDOWS, "shape": tiny_transformer.CONFIG},
    "infiller": {"batch": 200, "window": 32, "shape": tiny_infiller.CONFIG},
    "keyframe-timing": {},
    "path": {**_WINDOWS, "shape": tiny_path.CONFIG},
    "tweener": {**_WINDOWS, "shape": tiny_tweener.CONFIG},
    "stitcher": {**_WINDOWS, "shape": tiny_stitcher.CONFIG},
}
_QUICK = "lstm-gmm", "path"  # trained and validated in about a second


def small_settings(name: str, data: Path, out: Path, prior: str = "locomotion", **changes: Any) -> Any:
    """Settings of a model; `prior` is the density of a refiner."""
    own = _SMALL[name] | ({"density": prior} if name == "refiner" else {})
    return load_recipe(name)(
        **({"data": data, "out": out, "steps": 6, "validate_steps": 2, "quiet": True} | own | changes)
    )


def list_params(names: Iterable[str] = RECIPES) -> list:
    """Parameters of a test for these models; all but the quickest are marked slow."""
    return [pytest.param(name, marks=() if name in _QUICK else pytest.mark.slow, id=name) for name in names]
