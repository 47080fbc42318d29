"""What an actor is asked for, as films show it: marks in the world, and poses as bodies that one sees through."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from mapctl.mesh import colours
from mapctl.mesh.mannequin import Mannequin
from mapctl.mesh.primitives import Surface
from mapctl.motion import Motion
from scenes.content import Figure
from scenes.drawn_character import DrawnMotion

_LEAST_SECONDS = 0.3  # for which what is asked for at one moment is shown strongly
_FAINT = 0.25  # opacity of marks before and after their time
_TINT, _SHELL = 0.75, 0.012  # share of the colour of all that is asked for in a pose's; metres around its body


@dataclass(frozen=True, eq=False)
class Mark:
    """A thing to reach, to look at, or to be at."""

    surface: Surface
    """Its shape and its colours."""
    seconds: tuple[float, float]
    """From when to when it is asked for, seconds since the actor's first frame."""


@dataclass(frozen=True, eq=False)
class Wishes:
    """All that an actor is asked for, beside its curve."""

    marks: Sequence[Mark] = ()
    """Marks in the world."""
    poses: Sequence[Motion] = ()
    """Poses, each one frame in its place, of the actor's skeleton."""


@dataclass(frozen=True, eq=False)
class StagedWishes:
    """Wishes made ready for a film."""

    marks: Sequence[tuple[Surface, int, int]]
    """Shapes, and the film's first and last frame in which they are asked for."""
    poses: Sequence[Figure]
    """Bodies in the poses."""

    @staticmethod
    def of(wishes: Wishes, motion: Motion, start_seconds: float, drawn: DrawnMotion | None = None) -> "StagedWishes":
        """Prepare the wishes of an actor whose motion, at the film's rate, starts at a time; of a character that is
        drawn with its own mesh poses are shown with it too."""
        marks, fps = [], motion.fps
        for mark in wishes.marks:
            early, late = mark.seconds
            margin = max(0.0, _LEAST_SECONDS - (late - early)) / 2
            first, last = (round((start_seconds + at) * fps) for at in (early - margin, late + margin))
            marks.append((mark.surface, first, last))
        return StagedWishes(marks, _build_figures(wishes.poses, motion, drawn))

    def marks_at(self, frame: int) -> list[Surface]:
        """Return the marks in a frame of the film: strong while they are asked for, faint before and after."""
        return [
            surface if first <= frame <= last else _thin_out(surface, _FAINT) for surface, first, last in self.marks
        ]

    def all_marks(self) -> list[Surface]:
        """Return all marks as they are while they are asked for."""
        return [surface for surface, _, _ in self.marks]


def _build_figures(poses: Sequence[Motion], motion: Motion, drawn: DrawnMotion | None) -> list[Figure]:
    if not poses:
        return []
    if drawn is not None:
        bodies = [drawn.build_pose(pose, colours.rgb(colours.TARGET)) for pose in poses]
        return [Figure(body, 0, _TINT, toward=colours.TARGET, shell=_SHELL) for body in bodies]
    # A body's shoes are as its whole motion shows them flat; a pose alone may stand on its toes.
    whole = reduce(lambda joined, pose: joined.join(replace(pose, fps=motion.fps)), poses, motion)
    body = Mannequin(whole, colours.rgb(colours.TARGET))
    numbers = range(motion.num_frames, whole.num_frames)
    return [Figure(body, number, _TINT, toward=colours.TARGET, shell=_SHELL) for number in numbers]


def _thin_out(surface: Surface, opacity: float) -> Surface:
    return replace(surface, rgba=surface.rgba * np.array([1.0, 1.0, 1.0, opacity]))
