"""Missing values of a file: NaN where a number belongs, as trackers and spreadsheets write it."""

import re
from dataclasses import dataclass
from os import PathLike

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from mapctl.errors import FileFormatError

_FORMS = re.compile(r"(?<!\S)[+-]?(?:nan(?:\([^\s)]*\))?|1\.#(?:ind|qnan|snan)\S*)(?!\S)", re.IGNORECASE | re.ASCII)


@dataclass(frozen=True, eq=False)
class MissingValues:
    """Masks of the values of a motion that are missing, where the file has NaN."""

    rotations: Bool[Tensor, "frames joints"]
    """Missing local rotations; the motion repeats the last known one."""
    positions: Bool[Tensor, "frames joints"]
    """Missing positions in the parent, of the root in the world; the motion interpolates linearly between known."""

    @staticmethod
    def none(frames: int, joints: int) -> "MissingValues":
        """Return masks of a motion with so many `frames` and `joints` (a number of them) that lacks nothing."""
        return MissingValues(*torch.zeros(2, frames, joints, dtype=torch.bool))


def is_nan(word: str) -> bool:
    """Return whether a word of a text file stands for a missing number: `nan`, `-nan(ind)`, `1.#QNAN`."""
    return _FORMS.fullmatch(word) is not None


def normalise_nan(text: str) -> str:
    """Return the text with every form of a missing number spelled `nan`, which numpy reads."""
    return _FORMS.sub("nan", text) if "#" in text else text


def missing_hint(word: str) -> str:
    """Return what to add to an error message about a word: advice where it is a missing number."""
    return "; `mapctl infill` fills in what is lost" if is_nan(word) else ""


def check_any_known(path: str | PathLike[str], lost: np.ndarray) -> None:
    """Raise FileFormatError where every value (a boolean array) is missing."""
    if lost.size and lost.all():
        raise FileFormatError(path, "every value is nan: nothing is known of the motion")


def hold_last(values: np.ndarray) -> np.ndarray:
    """Fill NaN in columns (frames, width) with the last known number, at first the first; 0 where none is known."""
    known = ~np.isnan(values)
    if known.all():
        return values
    frame = np.arange(len(values))[:, None]
    nearest = np.maximum.accumulate(np.where(known, frame, known.argmax(axis=0)), axis=0)
    return np.where(known.any(axis=0), np.take_along_axis(values, nearest, axis=0), 0.0)


def interpolate_nan(values: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Interpolate NaN in columns (frames, width) linearly; `otherwise` (width,) where no number is known."""
    done, frame = values.copy(), np.arange(len(values))
    for column in np.flatnonzero(np.isnan(values).any(axis=0)):
        known = ~np.isnan(values[:, column])
        lone = np.full(len(values), otherwise[column])
        done[:, column] = np.interp(frame, frame[known], values[known, column]) if known.any() else lone
        done[known, column] = values[known, column]
    return done
