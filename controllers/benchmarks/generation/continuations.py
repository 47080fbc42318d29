"""Unseen clips gone on with: what a density makes of their first second, beside how they go on themselves.

Both sets then hold the same styles, gaits and lengths, so that a difference is the density's and not that of a mixture.
"""

from collections.abc import Sequence

import torch

from controllers.benchmarks.generation import Variant
from controllers.benchmarks.shared.held_out import NamedClip
from controllers.generation.generate import generate
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion

CONTEXT = 40  # frames of a clip that the density is shown; its memory has settled by then
_SHORTEST = PRIOR_FPS + 6  # frames that a clip must have after them, to hold a window


def select_long_clips(clips: Sequence[NamedClip]) -> list[NamedClip]:
    """Select clips that go on for a second and more after what the density is shown; RequestError if there are none."""
    long = [clip for clip in clips if clip.motion.num_frames >= CONTEXT + _SHORTEST]
    if not long:
        raise RequestError(f"no unseen clip is as long as {(CONTEXT + _SHORTEST) / PRIOR_FPS:.1f} s")
    return long


def cut_continuation(clip: NamedClip) -> Motion:
    """Cut off what the density is shown: how the clip itself goes on."""
    return clip.motion.slice(CONTEXT, clip.motion.num_frames)


def continue_clips(variant: Variant, clips: Sequence[NamedClip], seed: int) -> list[Motion]:
    """Generate as many frames after the beginning of each clip as it has itself, told its labels; the seed is that of
    the first."""
    settings, made = variant.settings(), []
    for number, clip in enumerate(clips):
        found = generate(
            variant.prior.conditioned_like_clip(clip.name),
            seconds=(clip.motion.num_frames - CONTEXT) / PRIOR_FPS,
            generator=torch.Generator().manual_seed(seed + number),
            settings=settings,
            start_clip=clip.motion.slice(0, CONTEXT),
            refiner=variant.refiner,
        )
        made.append(found.motion)
    return made
