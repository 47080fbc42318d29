"""Causal denoising for live capture: each frame is decided within a given delay after it arrives.

The last seconds are denoised again every few frames; of each pass the frames that are due are kept, crossfaded from the
previous pass's preview of them, so that the seam between two passes is continuous.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.denoising.solution import DenoiseSolution, crossfade, join_segments
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.protocols import Denoiser
from mapctl.recording.inspection import MIN_FRAMES
from mapctl.recording.masks import Mask, slice_masks, write_back_masked
from mapctl.retarget.rigs import Rig

_MAX_DELAY = 5.0
_STEP_SECONDS = 0.1  # between passes
_RIG_SECONDS = 1.0  # seconds from which the rig is identified


class CausalDenoiser:
    """Denoiser of one capture whose frames arrive one after the other."""

    def __init__(
        self,
        denoiser: Denoiser,
        *,
        settings: DenoiseSettings | None = None,
        delay: float = 0.2,
        past: float = 2.5,
        rig: Rig | None = None,
    ):
        """Begin without frames. A frame waits for at most `delay` seconds until it is decided, by passes that see
        `past` seconds before; `rig` overrides recognition."""
        if not 1 / PRIOR_FPS <= delay <= _MAX_DELAY:
            raise RequestError(f"the delay must be {1 / PRIOR_FPS:.2f} to {_MAX_DELAY:g} s, got {delay:g}")
        settings = settings or DenoiseSettings()
        if settings.only_faults or settings.capture == "video":
            asked = "faults are" if settings.only_faults else "the floor of a capture from video is"
            raise RequestError(
                f"{asked} found in the whole capture, which a causal run never sees; leave one of them out"
            )
        self._denoiser, self._settings, self._rig = denoiser, replace(settings, capture="studio"), rig
        self._rig_identified = False  # from the capture's beginning, which later passes do not see
        self.delay, self._history = delay, past
        self._past: Motion | None = None  # frames that a pass sees
        self._first = 0  # frame of the capture that they begin with
        self._delivered = 0  # number of frames returned so far
        self._previous: tuple[Motion, int] | None = None  # result of the previous pass, and its first frame
        self._masks: tuple[Mask, ...] = ()

    def compute_delay_frames(self, fps: float) -> tuple[int, int]:
        """Compute the longest wait of a frame, in frames, and how many fewer the last frame that a pass decides waits:
        at most half, so that a pass sees the rest beyond the frames that it decides.

        Whole frames within the delay: at 24 frames/s and 0.2 s four, which take 0.17 s.
        """
        return math.floor(self.delay * fps + 1e-9), max(1, round(min(_STEP_SECONDS, self.delay / 2) * fps))

    def push(self, frames: Motion, *, masks: Sequence[Mask] = ()) -> DenoiseSolution | None:
        """Take the next frames of the capture and return those that are due, None if none are. Masks count from the
        first frame of the capture."""
        most, step = self.compute_delay_frames(float(frames.fps))
        self._masks = (*self._masks, *masks)
        self._past = frames if self._past is None else self._past.join(frames)
        received = self._first + self._past.num_frames
        if received - 1 - self._delivered < most:  # the oldest can wait for another frame
            return None
        return self._denoise_recent(received - max(0, most + 1 - step))

    def finish(self) -> DenoiseSolution | None:
        """End the capture and return the frames that still wait, None if none do."""
        received = 0 if self._past is None else self._first + self._past.num_frames
        return self._denoise_recent(received) if received > self._delivered else None

    def _denoise_recent(self, due: int) -> DenoiseSolution:
        assert self._past is not None
        # Results for missing joints are written into the past: later passes see nothing else of them.
        end = self._first + self._past.num_frames
        masks = slice_masks(self._masks, self._first, end, since=self._delivered)
        done = denoise(self._past, self._denoiser, masks=masks, settings=self._settings, rig=self._rig)
        if not self._rig_identified and self._past.seconds >= _RIG_SECONDS:
            self._rig, self._rig_identified = done.rig, True
        start, count = self._delivered - self._first, due - self._delivered
        result = done.slice(start, start + count)
        notes = done.notes if self._delivered == 0 else ()
        if self._past.num_frames < MIN_FRAMES:
            notes = (f"frames {self._delivered}:{due} were due before noise could be estimated: they were not changed",)
        result = replace(result, status=replace(result.status, notes=notes))
        if self._previous is not None:
            past, first = self._previous
            shared = min(count, first + past.num_frames - self._delivered)
            if shared > 0:
                before = past.slice(self._delivered - first, self._delivered - first + shared)
                result = replace(result, motion=crossfade(before, result.motion, shared))
        past = self._past.slice(start, self._past.num_frames)
        part_masks = slice_masks(self._masks, self._delivered, self._delivered + past.num_frames)
        renewed = write_back_masked(past, result.motion, part_masks)
        self._past = self._past.slice(0, start).join(renewed) if start else renewed
        self._previous, self._delivered = (done.motion, self._first), due
        kept = max(1, round((self._history + self.delay) * float(self._past.fps)))
        dropped = min(self._past.num_frames - kept, self._delivered - self._first)
        if dropped > 0:  # frames before the history that a pass sees
            self._past, self._first = self._past.slice(dropped, self._past.num_frames), self._first + dropped
        return result


def denoise_causal(
    motion: Motion,
    denoiser: Denoiser,
    *,
    masks: Sequence[Mask] = (),
    settings: DenoiseSettings | None = None,
    delay: float = 0.2,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DenoiseSolution:
    """A whole motion through a CausalDenoiser, a frame at a time."""
    began = time.perf_counter()
    stream = CausalDenoiser(denoiser, settings=settings, delay=delay, rig=rig)
    pieces: list[tuple[DenoiseSolution, int]] = []
    delivered = 0
    for frame in range(motion.num_frames):
        new = stream.push(motion.slice(frame, frame + 1), masks=masks if frame == 0 else ())
        if frame + 1 == motion.num_frames:
            new = _concatenate_results(new, stream.finish())
        if new is not None:
            pieces.append((new, delivered))
            delivered += new.motion.num_frames
            if progress is not None:
                progress(delivered, motion.num_frames)
    whole = join_segments(pieces)
    note = f"causal: a frame is decided at most {stream.delay:.2f} s after it came"
    status = replace(whole.status, notes=(note, *whole.notes))
    return replace(whole, seconds=time.perf_counter() - began, status=status).assess()


def _concatenate_results(first: DenoiseSolution | None, second: DenoiseSolution | None) -> DenoiseSolution | None:
    """Concatenate two results, either of which may be None."""
    if first is None or second is None:
        return first or second
    return join_segments([(first, 0), (second, first.motion.num_frames)])
