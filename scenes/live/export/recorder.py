"""Begins and ends recordings, and has their files made one after another on a thread beside the show's own."""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import viser

from mapctl.errors import RequestError
from scenes.live.actor import LiveActor
from scenes.live.recording import ExportWork, Recording, RecordingDelivery


@dataclass(frozen=True, eq=False)
class _Job:
    recording: Recording
    ending: str
    client: viser.ClientHandle | None
    work: ExportWork


class Recorder:
    """Recordings of the chosen character. The last one is kept until the next is given out, so that a browser that
    goes away in the middle of a download loses nothing, and another kind of file can be made of it."""

    def __init__(self, chosen: Callable[[], LiveActor], delivery: RecordingDelivery, folder: Path | None):
        """Recordings grow in `folder`, or without a name."""
        self._chosen, self._delivery, self._folder = chosen, delivery, folder
        self._jobs: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._pending: list[_Job] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._last: Recording | None = None

    @property
    def recording(self) -> Recording | None:
        """What is being recorded of the chosen character."""
        return self._chosen().recording

    @property
    def last(self) -> Recording | None:
        """Recording that was ended last, of which another file can be made."""
        return self._last

    @property
    def work(self) -> tuple[str, ExportWork, int] | None:
        """Ending of the file that is being made, how far it is, and how many wait; None while none is."""
        pending = list(self._pending)
        return (pending[0].ending, pending[0].work, len(pending) - 1) if pending else None

    def toggle(self, ending: str, client: viser.ClientHandle | None) -> None:
        """Begin to record the chosen character, or end and give that browser a file of this ending."""
        member = self._chosen()
        if member.recording is None:
            member.start_recording(self._folder)
            return
        recording, member.recording = member.recording, None
        self._give_out(recording, ending, client)

    def save_again(self, ending: str, client: viser.ClientHandle | None) -> None:
        """Give a browser the last recording once more. RequestError where there is none."""
        if self._last is None:
            raise RequestError("nothing was recorded yet")
        self._give_out(self._last, ending, client)

    def cancel(self) -> None:
        """Break off the file that is being made; the recording is kept."""
        for job in self._pending[:1]:
            job.work.is_cancelled = True

    def close(self) -> None:
        """Break off all files. What was never given out stays in its file."""
        for job in list(self._pending):
            job.work.is_cancelled = True
        if self._thread is not None:
            self._thread.join(2.0)
        if self._last is not None and self._last.is_given_out:
            self._last.discard()
            self._last = None

    def _give_out(self, recording: Recording, ending: str, client: viser.ClientHandle | None) -> None:
        with self._lock:
            before, self._last = self._last, recording
            if before is not None:
                self._discard_unused(before)
            job = _Job(recording, ending, client, ExportWork())
            self._pending.append(job)
        self._jobs.put(job)
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def _work(self) -> None:
        while True:
            job = self._jobs.get()
            self._delivery.export(job.recording, job.ending, job.client, work=job.work, keeps=True)
            with self._lock:
                self._pending.remove(job)
                self._discard_unused(job.recording)

    def _discard_unused(self, recording: Recording) -> None:
        """Remove a recording's file that was given out and that nobody can ask for any more."""
        used = recording is self._last or any(job.recording is recording for job in self._pending)
        if recording.is_given_out and not used:
            recording.discard()
