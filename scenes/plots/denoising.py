"""Films of a motion before and after, side by side."""

from collections.abc import Callable
from dataclasses import replace
from os import PathLike

import torch

from mapctl import retarget
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from scenes.film import film

_SIDE_OFFSET = 1.4  # metres between the two of a film


def film_side_by_side(
    capture: Motion,
    clean: Motion,
    path: str | PathLike[str],
    *,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Film the capture, grey, and the result beside it."""
    before, after = (retarget.to_canonical(motion, rig)[0] for motion in (capture, clean))
    aside = torch.tensor([_SIDE_OFFSET, 0.0, 0.0], dtype=torch.float64)
    film(
        [(after, None), (replace(before, root_position=before.root_position + aside), None, "#999999")],
        path,
        progress=progress,
    )
