"""Recordings of the live viewer, kept as a motion and given out as a file."""

import itertools
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import torch
import viser

from mapctl import formats
from mapctl.errors import MapctlError, RequestError
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

FORMATS = ("bvh", "glb", "mp4")


@dataclass
class Recording:
    """Frames of one character, from one time on."""

    skeleton: Skeleton
    drawn: DrawnCharacter | None = None
    pieces: list[Motion] = field(default_factory=list)

    def add(self, delivered: FrameChunk) -> None:
        """Add delivered frames."""
        self.pieces.append(delivered.motion(self.skeleton))

    def motion(self) -> Motion:
        """Join all frames to a motion, on the joints of the character that is drawn; RequestError without frames."""
        if not self.pieces:
            raise RequestError("nothing was recorded")
        root = torch.cat([piece.root_position for piece in self.pieces])
        quats = make_sign_continuous(torch.cat([piece.local_quat_xyzw for piece in self.pieces]))
        motion = Motion(self.skeleton, self.pieces[0].fps, root, quats)
        return motion if self.drawn is None else self.drawn.put_on(motion).placed.motion


@dataclass(frozen=True)
class RecordedFile:
    """A recording as a file."""

    ending: str
    """Ending of the file, one of FORMATS."""
    content: bytes
    """Content of the file."""
    fallback_reason: str = ""
    """Reason why the ending is not the one asked for, if so."""

    @property
    def name(self) -> str:
        """Name under which the file is given out."""
        return f"mapctl.{self.ending}"


class RecordingDelivery:
    """Gives recordings to browsers, from a thread beside the show's own."""

    def __init__(self, server: viser.ViserServer, notices: Notifications):
        self._server, self._notices = server, notices

    def export(self, recording: Recording, ending: str, client: viser.ClientHandle | None) -> None:
        """Encode a recording and give it to the browser that asked; errors are said."""
        torch.set_num_threads(1)
        try:
            made = encode_with_fallback(recording.motion(), ending, recording.drawn)
            if made.ending != ending:
                self._notices.event(f"No {ending} could be made, here is a {made.ending}", made.fallback_reason)
            self._send(made, client)
        except Exception as error:
            self._notices.event("Nothing saved", format_error(error))

    def _send(self, made: RecordedFile, client: viser.ClientHandle | None) -> None:
        """Send the file to the browser that asked; to all others if it is gone; to the current folder if nobody is
        left."""
        others = self._server.get_clients()
        if client is None or client.client_id not in others:
            if not others:
                return self._notices.console(
                    f"nobody is left to take the recording: {save_without_replacing(made, Path.cwd())}"
                )
            return self._server.send_file_download(made.name, made.content, save_immediately=True)
        return client.send_file_download(made.name, made.content, save_immediately=True)


def encode_with_fallback(motion: Motion, ending: str, drawn: DrawnCharacter | None = None) -> RecordedFile:
    """Encode a file of that ending, or a BVH where none can be made, so that no recording is lost."""
    try:
        return RecordedFile(ending, encode_motion(motion, ending, drawn))
    except Exception as error:
        if ending == FORMATS[0]:
            raise
        return RecordedFile(FORMATS[0], encode_motion(motion, FORMATS[0]), str(error))


def save_without_replacing(made: RecordedFile, folder: Path) -> Path:
    """Write the file into a folder, under a name that nobody has: mapctl.bvh, mapctl-2.bvh, ..."""
    for number in itertools.count(1):
        path = folder / (made.name if number == 1 else f"mapctl-{number}.{made.ending}")
        with suppress(FileExistsError), path.open("xb") as file:
            file.write(made.content)
            return path
    raise AssertionError  # there is always another number


def encode_motion(motion: Motion, ending: str, drawn: DrawnCharacter | None = None) -> bytes:
    """Encode a file of one of FORMATS. A film is drawn in a process of its own, which takes a while; it shows the
    character that the motion is of, if there is one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{ending}"
        if ending != "mp4":
            formats.save(motion, path)
            return path.read_bytes()
        kept = Path(folder) / "motion.npz"
        formats.save(motion, kept)
        painter = spawn(_render_film, kept, path, None if drawn is None else drawn.path)
        painter.join()
        if not path.is_file():
            raise MapctlError("the film could not be drawn; `mapctl render` on a recorded BVH says why")
        return path.read_bytes()


def _render_film(source: Path, out: Path, character: str | None) -> None:
    motion = formats.load(source)
    drawn = None if character is None else DrawnCharacter.load(character).put_on(motion)
    film([Shot(motion, drawn=drawn)], out)
