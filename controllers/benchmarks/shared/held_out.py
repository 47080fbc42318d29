"""Clips held out from training, by kind."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from controllers.denoising.denoise import begins_with_tpose
from mapctl import formats, retarget
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion

HeldOut = Mapping[str, Sequence[str]]
"""Names of clips by the part of the data that they are in, as in a model's card."""

CLIP_KINDS: Mapping[str, str] = {
    "walks": r"bandai.*_walk_",
    "turning walks": r"bandai.*_walk-turn",
    "runs": r"bandai.*_(run|dash)_",
    "gestures, dance, fights": r"bandai",
    "CMU, 120 fps": r"cmu",
}
"""Kinds of clips, by the first pattern that is found in their path."""
_MAX_CLIP_SECONDS = 20.0  # seconds of a clip that are used


@dataclass(frozen=True, eq=False)
class CleanClip:
    """A clean clip and its kind."""

    kind: str
    """Key of CLIP_KINDS."""
    motion: Motion
    """Motion on its rig, without a leading T-pose."""


@dataclass(frozen=True, eq=False)
class NamedClip:
    """A clip and where it came from."""

    name: str
    """Its path below the data folder."""
    motion: Motion
    """Motion on canonical joints at PRIOR_FPS."""


def find_held_out(data: Path, held_out: HeldOut) -> list[Path]:
    """Find the held-out clips below the data folder, those first by which nothing was chosen in training; RequestError
    unless all are there."""
    paths = [data / name for part in ("test", "validation") for name in held_out.get(part, ())]
    if not paths or not all(path.is_file() for path in paths):
        missing = next((path for path in paths if not path.is_file()), "no clip at all")
        raise RequestError(f"{data} does not hold the clips kept from training: {missing}")
    return paths


def load_clean_clips(data: Path, held_out: HeldOut, count: int) -> list[CleanClip]:
    """Load about so many held-out clips, as many of each kind, without their T-poses: those first by which nothing was
    chosen in training, evenly spread over each kind's, for neighbours by name are of one action and one style."""
    paths = find_held_out(data, held_out)
    test_paths = {data / name for name in held_out.get("test", ())}
    count_each = max(1, count // len(CLIP_KINDS))
    clips = []
    for kind in CLIP_KINDS:
        of_kind = [path for path in paths if classify_clip(path.relative_to(data).as_posix()) == kind]
        tests = [path for path in of_kind if path in test_paths]
        others = [path for path in of_kind if path not in test_paths]
        for path in (*pick_evenly(tests, count_each), *pick_evenly(others, count_each - len(tests))):
            motion = formats.load(path)
            clips.append(CleanClip(kind, trim_clip(motion, skip_first=begins_with_tpose(motion))))
    return clips


def pick_evenly(paths: Sequence[Path], count: int) -> list[Path]:
    """Pick so many evenly from the first on, or all where there are no more."""
    count = min(count, len(paths))
    return [paths[number * len(paths) // count] for number in range(count)]


def load_canonical(data: Path, held_out: HeldOut, count: int, *, fps: int | None = None) -> dict[str, list[Motion]]:
    """Load held-out clips on canonical joints, by kind; resampled to `fps` if given."""
    kinds: dict[str, list[Motion]] = {}
    for clip in load_clean_clips(data, held_out, count):
        motion = retarget.to_canonical(clip.motion)[0]
        kinds.setdefault(clip.kind, []).append(motion if fps is None else motion.resample(fps))
    return kinds


def load_held_out(data: Path, held_out: HeldOut) -> list[Motion]:
    """Load all held-out clips of more than a second, whole, on canonical joints at PRIOR_FPS."""
    return [clip.motion for clip in load_named(data, held_out)]


def load_named(data: Path, held_out: HeldOut) -> list[NamedClip]:
    """Load all held-out clips of more than a second, whole, on canonical joints at PRIOR_FPS, with their names."""
    clips = [
        NamedClip(path.relative_to(data).as_posix(), retarget.to_canonical(formats.load(path))[0].resample(PRIOR_FPS))
        for path in find_held_out(data, held_out)
    ]
    return [clip for clip in clips if clip.motion.num_frames > PRIOR_FPS]


def classify_clip(name: str) -> str:
    """Return the kind of the first pattern that fits; `other` if none does."""
    return next((kind for kind, pattern in CLIP_KINDS.items() if re.search(pattern, name)), "other")


def trim_clip(motion: Motion, *, skip_first: bool) -> Motion:
    """Return the first seconds of a clip, without its frame 0 if that is a T-pose."""
    first = 1 if skip_first else 0
    return motion.slice(first, min(motion.num_frames, first + round(_MAX_CLIP_SECONDS * float(motion.fps))))
