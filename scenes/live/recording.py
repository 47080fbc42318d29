"""Recordings of the live viewer, kept as a motion and given out as a file."""

import itertools
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import torch

from mapctl import formats
from mapctl.errors import MapctlError, RequestError
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.processes import spawn
from mapctl.skeleton import Skeleton
from scenes.film import film

FORMATS = ("bvh", "glb", "mp4")


@dataclass
class Recording:
    """Frames of one character, from one time on."""

    skeleton: Skeleton
    pieces: list[Motion] = field(default_factory=list)

    def add(self, delivered: FrameChunk) -> None:
        """Add delivered frames."""
        self.pieces.append(delivered.motion(self.skeleton))

    def motion(self) -> Motion:
        """Join all frames to a motion; RequestError where there are none."""
        if not self.pieces:
            raise RequestError("nothing was recorded")
        root = torch.cat([piece.root_position for piece in self.pieces])
        quats = make_sign_continuous(torch.cat([piece.local_quat_xyzw for piece in self.pieces]))
        return Motion(self.skeleton, self.pieces[0].fps, root, quats)


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


def encode_with_fallback(motion: Motion, ending: str) -> RecordedFile:
    """Encode a file of that ending, or a BVH where none can be made, so that no recording is lost."""
    try:
        return RecordedFile(ending, encode_motion(motion, ending))
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


def encode_motion(motion: Motion, ending: str) -> bytes:
    """Encode a file of one of FORMATS. A film is drawn in a process of its own, which takes a while."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{ending}"
        if ending != "mp4":
            formats.save(motion, path)
            return path.read_bytes()
        kept = Path(folder) / "motion.npz"
        formats.save(motion, kept)
        painter = spawn(_render_film, kept, path)
        painter.join()
        if not path.is_file():
            raise MapctlError("the film could not be drawn; `mapctl render` on a recorded BVH says why")
        return path.read_bytes()


def _render_film(source: Path, out: Path) -> None:
    film([(formats.load(source), None)], out)
