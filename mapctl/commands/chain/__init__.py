"""`mapctl chain`: one long motion through pieces of many clips."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Chain(ModelCommand, options.RigOptions):
    """One long motion through short pieces of many clips, the gaps between them filled in; on the first clip's rig."""

    clips: tyro.conf.Positional[Annotated[tuple[Path, ...], arg(metavar="CLIP CLIP ...")]]
    """Motion files, of any known rigs."""
    out: options.OutFile
    """Where the motion goes, at 30 frames a second."""
    piece: options.Count = 40
    """Frames of a piece, from the middle of every clip."""
    gap: Annotated[str, arg(metavar="A:B")] = "50:100"
    """Frames between two pieces: sampled from A to B."""
    seed: options.Count = 0
    """Seed of the gaps' lengths and of what rollouts sample."""
    method: options.Method = "auto"
    """Who proposes, as in `mapctl infill`."""
    dna: options.MaybeDna = None
    """Motion files or classes whose style the tweener takes, as in `mapctl infill`."""
    no_finish: bool = False
    """Leave the proposal as it is, on rigid bones: no MAP stage plants the feet."""
    inbetweener: options.MaybeName = None
    """The file or run folder of a trained transformer, infiller or tweener; the bundled one if not given. With auto a
    tweener is for long gaps, beside the bundled transformer."""
    stitcher: options.MaybeName = None
    """The file or run folder of a trained stitcher for --method stitcher, where --inbetweener fills what it leaves, and
    for auto; the bundled one if not given."""
    path: options.MaybeName = None
    """The file or run folder of the path predictor that the tweener was trained with; the bundled one if not given."""
    video: options.MaybeFile = None
    """Film of the motion: .mp4, .gif, .webp or .png."""
    quiet: bool = False
    """No summary and no progress bar."""
