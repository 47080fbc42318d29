"""Denoising as a live capture needs it: each frame is decided within a stated delay after it came.

The last seconds are cleaned anew every few frames; of each pass the frames that are due are kept, and fade over from
what the pass before had foreseen for them, so that two passes never meet with a jump.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from controllers.denoising.denoise import MIN_DENOISE_FRAMES, denoise
from controllers.denoising.result import DenoiseSolution, crossfade, join_segments
from controllers.denoising.segment import DenoiseSettings
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.protocols import Denoiser
from mapctl.recording.masks import Mask, slice_masks, trim_masks_before, write_back_masked
from mapctl.retarget.rigs import Rig

_MAX_DELAY = 5.0
_RIG_SECONDS = 1.0  # seconds that show what rig a capture is on


@dataclass(frozen=True)
class CausalSettings:
    """How a stream is cut; seconds."""

    delay: float = 0.2
    """That a frame waits at most, until it is decided."""
    step: float = 0.1
    """Between passes: a pass sees at least the rest of the delay beyond the frames that it decides. Half of the delay
    at most."""
    past: float = 2.5
    """That a pass looks back on."""

    def __post_init__(self):
        if not 1 / PRIOR_FPS <= self.delay <= _MAX_DELAY:
            raise RequestError(f"the delay must be {1 / PRIOR_FPS:.2f} to {_MAX_DELAY:g} s, got {self.delay:g}")

    def compute_delay_frames(self, fps: float) -> tuple[int, int]:
        """How many frames a frame waits for at most, and how many fewer it has waited for that a pass decides last.

        Whole frames within the delay: at 24 a second and 0.2 s four, which take 0.17 s.
        """
        most = math.floor(self.delay * fps + 1e-9)
        return most, max(1, round(min(self.step, self.delay / 2) * fps))


class CausalDenoiser:
    """Takes the frames of one capture as they come, gives back clean ones."""

    def __init__(
        self,
        denoiser: Denoiser,
        *,
        settings: DenoiseSettings | None = None,
        causal: CausalSettings | None = None,
        rig: Rig | None = None,
    ):
        """`rig` wins over what would be recognised."""
        self._denoiser, self._settings, self._rig = denoiser, settings or DenoiseSettings(), rig
        self._told = False  # whether the rig was told from the capture's beginning, which later passes do not see
        self._causal = causal or CausalSettings()
        self._past: Motion | None = None  # what a pass sees
        self._first = 0  # the frame of the capture that it begins with
        self._given = 0  # frames that were given back
        self._foreseen: tuple[Motion, int] | None = None  # the last pass, and its first frame
        self._masks: tuple[Mask, ...] = ()

    @property
    def delay(self) -> float:
        """Seconds between a frame and its clean one, at most, but for the compute; at any rate of frames."""
        return self._causal.delay

    def push(self, frames: Motion, *, masks: Sequence[Mask] = ()) -> DenoiseSolution | None:
        """The next frames of the capture; returns those that are due by now, None if none are. Masks count from the
        first frame of all.
        """
        most, step = self._causal.compute_delay_frames(float(frames.fps))
        self._masks = (*self._masks, *masks)
        self._past = frames if self._past is None else self._past.join(frames)
        come = self._first + self._past.num_frames
        if come - 1 - self._given < most:  # the oldest may wait for another frame
            return None
        return self._denoise_recent(come - max(0, most + 1 - step))

    def finish(self) -> DenoiseSolution | None:
        """The frames that still wait; the capture is over."""
        come = 0 if self._past is None else self._first + self._past.num_frames
        return self._denoise_recent(come) if come > self._given else None

    def _denoise_recent(self, due: int) -> DenoiseSolution:
        assert self._past is not None
        # What was given back of a lost joint is written into the past: later passes may see nothing else of it.
        masks = slice_masks(
            trim_masks_before(self._masks, self._given), self._first, self._first + self._past.num_frames
        )
        done = denoise(self._past, self._denoiser, masks=masks, settings=self._settings, rig=self._rig)
        if not self._told and self._past.seconds >= _RIG_SECONDS:
            self._rig, self._told = done.rig, True
        start, count = self._given - self._first, due - self._given
        given = done.slice(start, start + count)
        given = replace(given, status=replace(given.status, notes=self._notes(done, due)))
        if self._foreseen is not None:
            old, first = self._foreseen
            shared = min(count, first + old.num_frames - self._given)
            if shared > 0:
                before = old.slice(self._given - first, self._given - first + shared)
                given = replace(given, motion=crossfade(before, given.motion, shared))
        old = self._past.slice(start, self._past.num_frames)
        lost = slice_masks(self._masks, self._given, self._given + old.num_frames)
        renewed = write_back_masked(old, given.motion, lost)
        self._past = self._past.slice(0, start).join(renewed) if start else renewed
        self._foreseen, self._given = (done.motion, self._first), due
        self._discard_past()
        return given

    def _notes(self, done: DenoiseSolution, due: int) -> tuple[str, ...]:
        """Of the frames that a pass decides: what it says of its beginning, the first has said."""
        assert self._past is not None
        if self._past.num_frames < MIN_DENOISE_FRAMES:
            few = f"frames {self._given}:{due} were due before noise could be told from motion: they were not changed"
            return (few,)
        return done.notes if self._given == 0 else ()

    def _discard_past(self) -> None:
        """What lies further back than a pass looks."""
        assert self._past is not None
        kept = max(1, round((self._causal.past + self._causal.delay) * float(self._past.fps)))
        dropped = min(self._past.num_frames - kept, self._given - self._first)
        if dropped > 0:
            self._past, self._first = self._past.slice(dropped, self._past.num_frames), self._first + dropped


def denoise_causal(
    motion: Motion,
    denoiser: Denoiser,
    *,
    masks: Sequence[Mask] = (),
    settings: DenoiseSettings | None = None,
    delay: float = CausalSettings.delay,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DenoiseSolution:
    """A whole motion through a CausalDenoiser, a frame at a time."""
    began = time.perf_counter()
    stream = CausalDenoiser(denoiser, settings=settings, causal=CausalSettings(delay=delay), rig=rig)
    pieces: list[tuple[DenoiseSolution, int]] = []
    given = 0
    for frame in range(motion.num_frames):
        new = stream.push(motion.slice(frame, frame + 1), masks=masks if frame == 0 else ())
        if frame + 1 == motion.num_frames:
            new = _concatenate_results(new, stream.finish())
        if new is not None:
            pieces.append((new, given))
            given += new.motion.num_frames
            if progress is not None:
                progress(given, motion.num_frames)
    whole = join_segments(pieces)
    note = f"causal: a frame is decided at most {stream.delay:.2f} s after it came"
    status = replace(whole.status, notes=(note, *whole.notes))
    return replace(whole, seconds=time.perf_counter() - began, status=status).assess()


def _concatenate_results(first: DenoiseSolution | None, second: DenoiseSolution | None) -> DenoiseSolution | None:
    """One after the other, as far as they are there."""
    if first is None or second is None:
        return first or second
    return join_segments([(first, 0), (second, first.motion.num_frames)])
