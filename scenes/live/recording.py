"""What was shown, kept as a motion and given out as a file."""

import multiprocessing
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import torch

from mapctl import formats
from mapctl.errors import MapctlError, RequestError
from mapctl.motion import Motion
from mapctl.rotations import sign_continuous
from mapctl.skeleton import Skeleton
from mapctl.streaming import Delivered

FORMATS = ("bvh", "glb", "mp4")


@dataclass
class Recording:
    """Frames of one character, from one moment on."""

    skeleton: Skeleton
    pieces: list[Motion] = field(default_factory=list)

    def add(self, delivered: Delivered) -> None:
        """Keep them."""
        self.pieces.append(delivered.motion(self.skeleton))

    def motion(self) -> Motion:
        """All of them; RequestError where there are none."""
        if not self.pieces:
            raise RequestError("nothing was recorded")
        root = torch.cat([piece.root_position for piece in self.pieces])
        quats = sign_continuous(torch.cat([piece.local_quat_xyzw for piece in self.pieces]))
        return Motion(self.skeleton, self.pieces[0].fps, root, quats)


def as_file(motion: Motion, ending: str) -> bytes:
    """The content of a file of one of FORMATS. A film is drawn in a process of its own, which takes a while."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{ending}"
        if ending != "mp4":
            formats.save(motion, path)
            return path.read_bytes()
        kept = Path(folder) / "motion.npz"
        formats.save(motion, kept)
        painter = multiprocessing.get_context("spawn").Process(target=_film, args=(kept, path))
        painter.start()
        painter.join()
        if not path.is_file():
            raise MapctlError("the film could not be drawn; `mapctl render` on a recorded BVH says why")
        return path.read_bytes()


def _film(source: Path, out: Path) -> None:
    from scenes.film import film

    film([(formats.load(source), None)], out)
