"""Recordings of the live viewer, kept as a motion and given out as a file."""

import io
import itertools
import logging
import multiprocessing
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
import viser

from mapctl import formats
from mapctl.errors import MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats.growing import MotionWriter, decode
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.processes import spawn
from mapctl.skeleton import Skeleton
from scenes.drawn_character import DrawnCharacter
from scenes.film import film
from scenes.live.access import format_error
from scenes.live.notifications import Notifications
from scenes.stage import Shot

_log = logging.getLogger(__name__)
FORMATS = ("bvh", "glb", "npz", "mp4", "gif")
_FILMS = ("mp4", "gif")
_LONG_FRAMES = 900  # from which on a file is written in a process of its own: it takes a second and more
_WATCH_SECONDS = 0.1  # between two looks at a process that makes a file
_ENDING = ".recording"  # of the file of a recording


class Recording:
    """Frames of one character, from one time on, in a file that grows: memory stays as it is, and a crash of this
    program loses none (`mapctl convert` reads the file)."""

    def __init__(
        self,
        skeleton: Skeleton,
        drawn: DrawnCharacter | None = None,
        folder: Path | None = None,
        *,
        on_rig: Callable[[Motion], Motion] | None = None,
        licence: str = "",
    ):
        """The file is in `folder`, under a name that nobody has; without one it has no name, and goes with this
        program. `on_rig` puts the motion on the joints on which it is given out, where there is another rig. Formats
        that can tell the `licence`."""
        self.skeleton, self.drawn, self.on_rig, self._folder = skeleton, drawn, on_rig, folder
        self._licence = licence
        self.path: Path | None = None
        """File of the recording, once it has frames and a name."""
        self.fault = ""
        """Why frames are added no more; empty while they are."""
        self.is_given_out = False
        """Whether a file was made of it and sent."""
        self._file: io.FileIO | None = None
        self._writer: MotionWriter | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return 0 if self._writer is None else self._writer.frames

    @property
    def seconds(self) -> float:
        """Length, seconds."""
        return self.frames / PRIOR_FPS

    def add(self, delivered: FrameChunk) -> None:
        """Add delivered frames; where they cannot be written, `fault` says why, and what there is remains."""
        if self.fault:
            return
        try:
            if self._writer is None:
                self._file = self._open()
                self._writer = MotionWriter(self._file)
            self._writer.add(replace(delivered.motion(self.skeleton), licence=self._licence))
        except OSError as error:
            self.fault = error.strerror or str(error)

    def motion(self) -> Motion:
        """Join all frames to a motion, on the joints of its rig or of the character that is drawn.

        RequestError without frames.
        """
        if self._file is None or not self.frames:
            raise RequestError(f"nothing was recorded{self.fault and f' ({self.fault})'}")
        self._file.seek(0)
        motion = decode(self.path or "the recording", self._file.read())
        motion = replace(motion, skeleton=self.skeleton, local_quat_xyzw=make_sign_continuous(motion.local_quat_xyzw))
        if self.on_rig is not None:
            motion = self.on_rig(motion)
        elif self.drawn is not None:
            motion = self.drawn.put_on(motion).placed.motion
        return replace(motion, licence=self._licence)

    def discard(self) -> None:
        """Remove the file: what was recorded is kept elsewhere, or nobody wants it."""
        if self._file is not None:
            self._file.close()
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _open(self) -> io.FileIO:
        if self._folder is None:
            return tempfile.TemporaryFile(buffering=0)
        try:
            self.path, file = _open_new(self._folder, f"mapctl{_ENDING}")
        except PermissionError:
            self.path, file = _open_new(Path(tempfile.gettempdir()), f"mapctl{_ENDING}")
        return file


@dataclass(frozen=True)
class RecordedFile:
    """A recording as a file."""

    ending: str
    """Ending of the file, one of FORMATS."""
    content: bytes
    """Content of the file."""
    fallback_reason: str = ""
    """Reason why the ending is not the one asked for, if so."""
    stem: str = "mapctl"
    """Name of the file without its ending."""

    @property
    def name(self) -> str:
        """Name under which the file is given out."""
        return f"{self.stem}.{self.ending}"


@dataclass
class ExportWork:
    """How far the file of a recording is; whoever watches may break it off."""

    done: int = 0
    """Frames that are drawn."""
    total: int = 0
    """Frames in all; 0 where they are not counted."""
    is_cancelled: bool = False
    """Whether the work is to end without a file."""


class ExportCancelled(Exception):
    """Somebody broke the work off."""


class RecordingDelivery:
    """Gives recordings to browsers, from a thread beside the show's own."""

    def __init__(self, server: viser.ViserServer, notices: Notifications):
        self._server, self._notices = server, notices

    def export(
        self,
        recording: Recording,
        ending: str,
        client: viser.ClientHandle | None,
        *,
        work: ExportWork | None = None,
        keeps: bool = False,
    ) -> None:
        """Encode a recording and give it to the browser that asked; errors are said. The recording is discarded where
        it is given out, unless its maker `keeps` it."""
        torch.set_num_threads(1)
        try:
            made = encode_with_fallback(recording.motion(), ending, recording.drawn, work)
            if made.ending != ending:
                self._notices.event(f"No {ending} could be made, here is a {made.ending}", made.fallback_reason)
            self._send(made, client)
            recording.is_given_out = True
            if not keeps:
                recording.discard()
        except ExportCancelled:
            self._notices.event("Broken off", f"no {ending} was made; the recording is kept", console=False)
        except Exception as error:
            kept = "" if recording.path is None else f"; what was recorded is in {recording.path}"
            self._notices.event("Nothing saved", format_error(error) + kept)

    def _send(self, made: RecordedFile, client: viser.ClientHandle | None) -> None:
        """Send the file to the browser that asked; to all others if it is gone; to the current folder if nobody is
        left, or it goes away just now."""
        others = self._server.get_clients()
        asker = client if client is not None and client.client_id in others else None
        try:
            if others:
                (asker or self._server).send_file_download(made.name, made.content, save_immediately=True)
                return
        except Exception as error:  # whatever the library raises for a connection that ends
            _log.info("a browser went away: %s", format_error(error))
        self._notices.console(f"nobody is left to take the recording: {save_without_replacing(made, Path.cwd())}")


def encode_with_fallback(
    motion: Motion, ending: str, drawn: DrawnCharacter | None = None, work: ExportWork | None = None
) -> RecordedFile:
    """Encode a file of that ending, or a BVH where none can be made, so that no recording is lost. ExportCancelled
    where the work was broken off."""
    try:
        return RecordedFile(ending, encode_motion(motion, ending, drawn, work))
    except ExportCancelled:
        raise
    except Exception as error:
        if ending == FORMATS[0]:
            raise
        return RecordedFile(FORMATS[0], encode_motion(motion, FORMATS[0]), str(error))


def save_without_replacing(made: RecordedFile, folder: Path) -> Path:
    """Write the file into a folder, under a name that nobody has: mapctl.bvh, mapctl-2.bvh, ..."""
    path, file = _open_new(folder, made.name)
    with file:
        file.write(made.content)
    return path


def _open_new(folder: Path, name: str) -> tuple[Path, io.FileIO]:
    """Open a file that is new under this name, or under the next: mapctl.bvh, mapctl-2.bvh, ..."""
    first = folder / name
    for number in itertools.count(1):
        path = first if number == 1 else first.with_name(f"{first.stem}-{number}{first.suffix}")
        with suppress(FileExistsError):
            return path, path.open("x+b", buffering=0)
    raise AssertionError  # there is always another number


def encode_motion(
    motion: Motion, ending: str, drawn: DrawnCharacter | None = None, work: ExportWork | None = None
) -> bytes:
    """Encode a file of one of FORMATS. A film, which shows the character that the motion is of if there is one, and a
    long file are made in a process of their own, which ends where `work` is cancelled (ExportCancelled)."""
    work = work or ExportWork()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{ending}"
        if ending not in _FILMS and (motion.num_frames < _LONG_FRAMES or drawn is not None):
            formats.save(motion, path)
            return path.read_bytes()
        kept = Path(folder) / "kept.npz"
        formats.save(motion, kept)
        reader, writer = multiprocessing.Pipe(duplex=False)
        with reader, writer:
            if ending in _FILMS:
                maker = spawn(_render_film, kept, path, None if drawn is None else drawn.path, writer)
            else:
                maker = spawn(_write_file, kept, path)
            _watch(maker, reader, work)
        if not path.is_file():
            what = "film could not be drawn" if ending in _FILMS else "file could not be written"
            raise MapctlError(f"the {what}; `mapctl render` on a recorded BVH says why")
        return path.read_bytes()


def _watch(maker: Any, reader: Any, work: ExportWork) -> None:
    """Wait for a process, note how far it is, and end it where the work is cancelled."""
    while maker.is_alive():
        if reader.poll(_WATCH_SECONDS):
            work.done, work.total = reader.recv()
        if work.is_cancelled:
            maker.kill()
            maker.join()
            raise ExportCancelled
    maker.join()


def _render_film(source: Path, out: Path, character: str | None, report: Connection) -> None:
    motion = formats.load(source)
    drawn = None if character is None else DrawnCharacter.load(character).put_on(motion)
    film([Shot(motion, drawn=drawn)], out, progress=lambda done, total: report.send((done, total)))


def _write_file(source: Path, out: Path) -> None:
    formats.save(formats.load(source), out)
