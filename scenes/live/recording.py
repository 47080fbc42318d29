"""Recordings of live characters, and the files that are made of them."""

import itertools
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
import viser

from mapctl import formats
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.runtime.live_protocol import FrameChunk
from scenes.live.character import ShownCharacter

FORMATS = ("bvh", "glb", "npz")
"""Endings of the files."""


class Recorder:
    """Recordings of characters; the last one is kept, so that a file of another format can be made of it."""

    def __init__(self, server: viser.ViserServer, notify: Callable[[str, str], None]):
        """Files go to browsers of `server`; `notify` shows a note: title and text."""
        self._server, self._notify = server, notify
        self._thread: threading.Thread | None = None
        self.last: Motion | None = None
        """Last recording."""

    def toggle(self, character: ShownCharacter, ending: str, client: viser.ClientHandle | None) -> None:
        """Begin to record a character, or end and give the browser a file of this ending. RequestError without
        frames."""
        if character.recorded is None:
            character.recorded = []
            return
        chunks, character.recorded = character.recorded, None
        self.last = join_chunks(character, chunks)
        self.save_last(ending, client)

    def save_last(self, ending: str, client: viser.ClientHandle | None) -> None:
        """Give a browser the last recording as a file of this ending; from a thread, since a long one takes seconds.
        RequestError where there is none."""
        if self.last is None:
            raise RequestError("nothing was recorded yet")
        motion = self.last

        def work() -> None:
            torch.set_num_threads(1)
            try:
                self._send(f"mapctl.{ending}", encode_motion(motion, ending), client)
            except Exception as error:
                self._notify("Nothing saved", f"{type(error).__name__}: {error}")

        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def wait(self, seconds: float = 10.0) -> None:
        """Wait for the file that is being made."""
        if self._thread is not None:
            self._thread.join(seconds)

    def _send(self, name: str, content: bytes, client: viser.ClientHandle | None) -> None:
        """Send a file to a browser; write it into the current folder where that browser is gone."""
        if client is not None and client.client_id in self._server.get_clients():
            client.send_file_download(name, content, save_immediately=True)
        else:
            self._notify("Saved", f"the recording is in {write_new(Path.cwd() / name, content).name}")


def join_chunks(character: ShownCharacter, chunks: Sequence[FrameChunk]) -> Motion:
    """Join recorded frames to a motion on the joints of the character's rig. RequestError without frames."""
    if not chunks:
        raise RequestError("nothing was recorded")
    pieces, look = [chunk.motion(character.character.skeleton) for chunk in chunks], character.look
    quats = make_sign_continuous(torch.cat([piece.local_quat_xyzw for piece in pieces]))
    roots = torch.cat([piece.root_position for piece in pieces])
    motion = replace(pieces[0], root_position=roots, local_quat_xyzw=quats)
    if look.on_rig is not None:
        motion = look.on_rig(motion)
    elif look.drawn is not None:
        motion = look.drawn.put_on(motion).placed.motion
    return replace(motion, licence=look.licence)


def encode_motion(motion: Motion, ending: str) -> bytes:
    """Encode a file of one of FORMATS."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{ending}"
        formats.save(motion, path)
        return path.read_bytes()


def write_new(path: Path, content: bytes) -> Path:
    """Write a new file under this name, or under the next that is free: mapctl.bvh, mapctl-2.bvh, ..."""
    for number in itertools.count(1):
        free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        with suppress(FileExistsError), free.open("xb") as file:
            file.write(content)
            return free
    raise AssertionError  # there is always another number


def describe_length(chunks: Sequence[FrameChunk]) -> str:
    """Describe how long a recording is: 1:02.3, 1869 frames."""
    frames = sum(len(chunk.root) for chunk in chunks)
    minutes, seconds = divmod(frames / PRIOR_FPS, 60)
    return f"{int(minutes)}:{seconds:04.1f}, {frames} frame{'s' * (frames != 1)}"
