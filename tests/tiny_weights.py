"""A folder of bundled weights, of a few kilobytes each, in place of those that come with the package."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tiny_denoiser import save_tiny_denoiser
from tiny_files import make_card
from tiny_path import save_tiny_path
from tiny_prior import save_tiny_prior
from tiny_refiner import refiner_of
from tiny_stitcher import save_tiny_stitcher
from tiny_transformer import save_tiny_transformer
from tiny_tweener import save_tiny_tweener

from priors import checkpoints
from priors.keyframe_timing import KeyframeTimingConfig, KeyframeTimingNetwork

FREE = "free for any use"
MODELS = (
    "denoiser",
    "general",
    "keyframe-timing",
    "locomotion",
    "locomotion-live",
    "locomotion-refiner",
    "path",
    "stitcher",
    "transformer",
    "tweener",
)
"""All models of a whole set."""


def save_tiny_weights(folder: Path, licence: str = FREE, *, models: Sequence[str] = MODELS) -> Path:
    """Write the models of a set, all under this licence; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(("locomotion", "locomotion-live", "general")):
        save_tiny_prior(folder / f"{name}.safetensors", seed=seed)
    save_tiny_denoiser(folder / "denoiser.safetensors")
    save_tiny_stitcher(folder / "stitcher.safetensors")
    save_tiny_transformer(folder / "transformer.safetensors")
    save_tiny_tweener(folder / "tweener.safetensors", str(save_tiny_path(folder / "path.safetensors")))
    refiner = refiner_of()
    checkpoints.save(refiner.network.state_dict(), refiner.card, folder / "locomotion-refiner.safetensors")
    _save_timing(folder / "keyframe-timing.safetensors")
    for name in MODELS:
        change_card(folder / f"{name}.json", licence=licence)
        if name not in models:
            (folder / f"{name}.json").unlink()
            (folder / f"{name}.safetensors").unlink()
    return folder


def change_card(path: Path, **changes: Any) -> None:
    """Change fields of a card; those that are tables are added to."""
    card = json.loads(path.read_text(encoding="utf-8"))
    for key, value in changes.items():
        card[key] = {**card[key], **value} if isinstance(value, Mapping) else value
    path.write_text(json.dumps(card), encoding="utf-8")


def _save_timing(path: Path) -> None:
    network = KeyframeTimingNetwork(KeyframeTimingConfig())
    checkpoints.save(network.state_dict(), make_card("keyframe-timing", network.config), path)
