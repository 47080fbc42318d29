"""Licences of what commands write: of the models that were used, and of the motions that were given."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mapctl import formats
from mapctl.motion import Motion
from priors import licences


def add_licence(report: Mapping[str, Any]) -> dict[str, Any]:
    """Add to a report the licences of the models that were used, the strictest first."""
    return {**report, **licences.describe_licences(licences.find_used_licences())}


def format_used_licences() -> str:
    """Format the licences of what was used so far for a file: without the folders of models and motions."""
    return licences.format_licences(licences.shorten_names(licences.find_used_licences()))


def mark_motion(motion: Motion) -> Motion:
    """Mark a motion with the licences of what was used so far, where anything was."""
    told = format_used_licences()
    return replace(motion, licence=told) if told else motion


def save_motion(motion: Motion, path: Path) -> None:
    """Write a motion with the licences of what it was made with, in formats that keep them."""
    formats.save(mark_motion(motion), path)
