"""The past of live characters: the last two minutes, shown again and replayed, and recordings."""

import itertools
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
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
from scenes.live.character import KEPT_SECONDS, ShownCharacter

FORMATS = ("bvh", "glb", "npz")
"""Endings of the files."""


class Recorder:
    """Recordings of characters."""

    def __init__(self, server: viser.ViserServer, notify: Callable[[str, str], None]):
        """Files go to browsers of `server`; `notify` shows a note: title and text."""
        self._server, self._notify = server, notify
        self._pool = ThreadPoolExecutor(1)  # a long recording takes seconds
        self._saved: Future[None] | None = None

    def toggle(self, character: ShownCharacter, ending: str, client: viser.ClientHandle | None) -> None:
        """Begin to record a character, or end and give the browser a file of this ending; write it into the current
        folder where that browser is gone. RequestError without frames."""
        if character.recorded is None:
            character.recorded = []
            return
        chunks, character.recorded = character.recorded, None
        self._saved = self._pool.submit(self._save, join_chunks(character, chunks), ending, client)

    def wait(self) -> None:
        """Wait for the file that is being written."""
        if self._saved is not None:
            self._saved.result()

    def _save(self, motion: Motion, ending: str, client: viser.ClientHandle | None) -> None:
        try:
            name, content = f"mapctl.{ending}", encode_motion(motion, ending)
            if client is not None and client.client_id in self._server.get_clients():
                client.send_file_download(name, content, save_immediately=True)
            else:
                self._notify("Saved", f"the recording is in {write_new(Path.cwd() / name, content).name}")
        except Exception as error:
            self._notify("Nothing saved", f"{type(error).__name__}: {error}")


def join_chunks(character: ShownCharacter, chunks: Sequence[FrameChunk]) -> Motion:
    """Join recorded frames to a motion on the joints of the character's rig. RequestError without frames."""
    if not chunks:
        raise RequestError("nothing was recorded")
    pieces, look = [chunk.motion(character.character.skeleton) for chunk in chunks], character.look
    quats = make_sign_continuous(torch.cat([piece.local_quat_xyzw for piece in pieces]))
    roots = torch.cat([piece.root_position for piece in pieces])
    motion = replace(pieces[0], root_position=roots, local_quat_xyzw=quats)
    return replace(look.on_rig(motion), licence=look.licence)


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


class Timeline:
    """Looking back stops the characters, so that none moves on unseen; returning lets them go on."""

    def __init__(self, characters: Sequence[ShownCharacter], pause: Callable[[bool], None]):
        """`pause` stops all characters, or lets them go on."""
        self._characters, self._pause = characters, pause
        self.seconds_back: float | None = None
        """How far back the shown moment is; None for the present."""
        self._replayed: float | None = None  # value of time.perf_counter up to which was replayed

    @property
    def kept_seconds(self) -> float:
        """How far back one can look, seconds."""
        return max(len(character.past) for character in self._characters) / PRIOR_FPS

    def look_back(self, seconds: float) -> None:
        """Show what was so many seconds ago, or the oldest frame."""
        self._pause(True)
        self._replayed = None
        self.seconds_back = min(max(0.0, seconds), self.kept_seconds)

    def replay(self) -> None:
        """Play from the shown moment, or from as far back as there is, to the present."""
        self.look_back(self.seconds_back or self.kept_seconds)
        self._replayed = time.perf_counter()

    def return_to_present(self) -> None:
        """Show the present again; characters go on."""
        if self.seconds_back is not None:
            self.seconds_back = self._replayed = None
            for character in self._characters:
                character.show_past(0)
            self._pause(False)

    def step(self, now: float) -> None:
        """Show the past at a value of time.perf_counter; nothing in the present."""
        if self.seconds_back is None:
            return
        if self._replayed is not None:
            self.seconds_back -= now - self._replayed
            self._replayed = now
        if self.seconds_back <= 0 and self._replayed is not None:
            self.return_to_present()
            return
        for character in self._characters:
            character.show_past(round(self.seconds_back * PRIOR_FPS))

    def describe(self) -> str:
        """Describe what is shown, in a line."""
        if self.seconds_back is None:
            return f"Live. Look back up to {min(self.kept_seconds, KEPT_SECONDS):.0f} s."
        doing = "Past" if self._replayed is None else "Replay"
        return f"**{doing}, {self.seconds_back:.1f} s ago.** The characters wait."
