"""Sequences of keys far apart, as the generator of long in-betweens is trained on them (Zhou et al. 2020, appendix C).

A sequence is one window of a clip, or excerpts of several clips one after the other with a long gap at every splice.
Gaps grow in the course of training.

Keys that tell less than whole poses (Zhou et al. 2020, section 5): halves, the hips alone, some joints, places on
the ground, and drawings seen from one side.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL
from priors.training.augmentation.pose_windows import PoseWindows, choose_rows
from priors.tweening.keys import ToldParts

_JOINTS = CANONICAL.num_joints
_LEGS = frozenset(j for j, name in enumerate(CANONICAL.names) if name.endswith(("Leg", "Foot", "Toes")))


@dataclass(frozen=True)
class PartSettings:
    """How many sequences have keys that are not whole, and what these tell."""

    halves: float = 0.1
    """Share of sequences with keys of half a body, of the hips alone or of some joints."""
    places: float = 0.1
    """Share of sequences with keys that are nothing but places on the ground."""
    drawings: float = 0.1
    """Share of sequences with keys that are seen from one side."""


WHOLE = PartSettings(halves=0.0, places=0.0, drawings=0.0)
"""Keys are whole poses."""


def tell_parts(
    known: Bool[Tensor, "batch frames"],
    heading: Float[Tensor, "batch frames"],
    settings: PartSettings,
    rolls: Iterator[float],
) -> ToldParts:
    """Choose what is told in frames that are keys, of motions with these headings, radians: of most sequences all of
    the pose."""
    told = ToldParts.whole(known)
    axes, faced, view = told.axes.clone(), told.heading.clone(), told.view.clone()
    for row in range(len(known)):
        kind = next(rolls)
        runs = [slice(start, stop) for _, start, stop in true_intervals(known[row][:, None])]
        if not runs:
            continue
        if (kind := kind - settings.halves) < 0:
            for run in runs:
                axes[row, run] = _draw_part(rolls)[:, None]
        elif (kind := kind - settings.places) < 0:
            whole = 0.4 * (next(rolls) < 0.6)
            for run in runs:
                if next(rolls) >= whole:
                    axes[row, run], faced[row, run] = _PLACE, False
        elif kind - settings.drawings < 0:
            view[row] = _draw_view(float(heading[row, runs[0].start]), rolls)
            for run in runs:
                if next(rolls) < 0.75:
                    axes[row, run], faced[row, run] = False, False
                    axes[row, run.start] = _draw_drawing(rolls)
    return ToldParts(axes, faced, view)


def _see_joints(turning: Iterable[int]) -> Bool[Tensor, " joints"]:
    """Return which joints' positions are told by rotations of some."""
    told, rotations = [True], set(turning)
    for parent in CANONICAL.parents[1:]:
        told.append(told[parent] and parent in rotations)
    return torch.tensor(told)


_UPPER, _LOWER = (_see_joints({0, *part}) for part in (set(range(_JOINTS)) - _LEGS, _LEGS))
_HIPS = _see_joints({0})
_PLACE = torch.zeros(_JOINTS, 3, dtype=torch.bool)
_PLACE[0, ::2] = True


def _draw_part(rolls: Iterator[float]) -> Bool[Tensor, " joints"]:
    """Draw which joints are told of a key."""
    kind = next(rolls)
    for share, part in ((0.3, _UPPER), (0.3, _LOWER), (0.1, _HIPS), (0.15, torch.ones(_JOINTS, dtype=torch.bool))):
        if (kind := kind - share) < 0:
            return part
    return _see_joints({0} | {joint for joint in range(_JOINTS) if next(rolls) < 0.8})


def _draw_view(heading: float, rolls: Iterator[float]) -> float:
    """Draw from where somebody is seen, radians: half of the time from before, behind, the side or between these."""
    around = next(rolls)
    return heading + round(8 * around) * math.pi / 4 if next(rolls) < 0.5 else 2 * math.pi * around


def _draw_drawing(rolls: Iterator[float]) -> Bool[Tensor, "joints 3"]:
    """Draw which coordinates a drawing tells: two of all joints or of some; the third of the hips' if they are
    placed."""
    drawn = torch.ones(_JOINTS, dtype=torch.bool)
    if next(rolls) < 0.4:
        drawn = torch.tensor([next(rolls) < 0.7 for _ in range(_JOINTS)])
        drawn[0] = True
    axes = drawn[:, None] & torch.tensor([True, True, False])
    axes[0, 2] = next(rolls) < 0.5
    return axes


_SPLICED_FROM = 90  # frames of the shortest gap with a splice, 3 s
_ROLLS = 4096  # random numbers drawn at once


@dataclass(frozen=True)
class KeySettings:
    """Where keys lie."""

    first_longest: float = 30.0
    """Frames of the longest gap when training begins."""
    longest: float = 480.0
    """And when it has grown up (paper: 600 at 60 fps)."""
    shortest: float = 30.0
    """Frames of the shortest that a sequence's longest gap may be; the logarithm is drawn evenly."""
    grown: float = 0.25
    """Share of training after which gaps grow no more."""
    runs: float = 0.4
    """Share of keys that are several frames: a pose and its pace."""
    run: int = 12
    """Frames of such a key, at most."""
    open_ends: float = 0.1
    """Share of sequences that begin, and as many that end, without a key."""
    speed: float = 1.5
    """Speed, m/s, below which the hips travel where clips are spliced: distances are proportional to the time."""
    parts: PartSettings = field(default_factory=PartSettings)
    """How much keys tell."""

    def longest_at(self, progress: float) -> float:
        """Return the frames of the longest gap at a `progress` of training from 0 to 1."""
        share = min(1.0, progress / self.grown)
        return self.first_longest * (self.longest / self.first_longest) ** share


@dataclass(frozen=True, eq=False)
class KeySequences:
    """A batch of sequences of one length."""

    motion: PartialMotion
    """Poses by frame; between keys of different clips they are anything finite."""
    told: ToldParts
    """What is told of the frames that are keys."""
    truthful: Bool[Tensor, "batch frames"]
    """Whether the poses between the keys are a performer's."""
    clip: Int[Tensor, "batch frames"]
    """Number of the clip that a frame is of."""
    mirrored: Bool[Tensor, " batch"]
    """Whether left and right are exchanged."""

    @property
    def known(self) -> Bool[Tensor, "batch frames"]:
        """Whether a frame is a key."""
        return self.told.known


def draw_windows(
    windows: PoseWindows,
    batch: int,
    frames: int,
    settings: KeySettings,
    *,
    progress: float,
    tempo: float,
    generator: torch.Generator,
) -> KeySequences:
    """Draw windows of single clips, half of them up to the share `tempo` slower or faster, and keys in them."""
    varied = torch.rand(batch, generator=generator) < 0.5
    pace = torch.where(varied, 1 + tempo * (2 * torch.rand(batch, generator=generator) - 1), 1.0)
    clip, first = windows.picker.pick(1 + ((frames - 1) * pace).ceil().long(), generator)
    motion = windows.at(clip, first, frames, pace)
    rolls = _roll(generator)
    known = torch.zeros(batch, frames, dtype=torch.bool)
    for row in known:
        for start, stop in _lay_keys(frames, settings, settings.longest_at(progress), rolls):
            row[start:stop] = True
    everywhere = torch.ones_like(known)
    clip = clip[:, None].expand_as(known)
    return _finish(motion, known, everywhere, clip, settings.parts, rolls, generator)


def draw_splices(
    windows: PoseWindows, batch: int, frames: int, settings: KeySettings, *, progress: float, generator: torch.Generator
) -> KeySequences:
    """Draw keys of several clips: of one under 3 s, above that of another one the likelier the longer the gap is."""
    rolls, longest = _roll(generator), settings.longest_at(progress)
    shape = (batch, frames)
    clip, time = (torch.zeros(shape, dtype=torch.long) for _ in range(2))
    known, truthful = (torch.zeros(shape, dtype=torch.bool) for _ in range(2))
    turn, shift = torch.zeros(shape), torch.zeros(*shape, 2)
    for row in range(batch):
        for part in _splice(windows, frames, settings, longest, rolls, generator):
            during, key = slice(part.start, None), slice(part.key, part.stop)
            clip[row, during] = part.clip
            time[row, during] = part.first + torch.arange(frames - part.start)
            turn[row, during], shift[row, during] = part.turn, part.shift
            known[row, key] = True
            truthful[row, part.truthful_from : part.stop] = True
    motion = _place(windows.gather(clip, time.double()), turn, shift)
    return _finish(motion, known, truthful, clip, settings.parts, rolls, generator)


@dataclass(frozen=True, eq=False)
class _Part:
    """A key, and the excerpt of a clip that it belongs to and that goes on until another part begins."""

    clip: int
    start: int  # frame of the sequence at which the excerpt begins
    first: int  # and the clip's frame there
    key: int  # frame of the sequence at which the key begins
    stop: int  # and one past its end
    truthful_from: int  # since when the sequence is the clip
    turn: float  # of the excerpt about +Y, radians
    shift: Float[Tensor, " 2"]  # and over the ground, metres, behind the turn

    def time_at(self, frame: int) -> int:
        return self.first + frame - self.start


def _splice(
    windows: PoseWindows,
    frames: int,
    settings: KeySettings,
    longest: float,
    rolls: Iterator[float],
    generator: torch.Generator,
) -> Iterator[_Part]:
    """Yield the keys of a sequence in temporal order."""
    length = _draw_longest(settings, longest, rolls)
    part = _begin(windows, settings, rolls, generator)
    while part.key < frames:
        yield part
        gap = _draw_gap(length, rolls)
        last = part.stop - 1
        room = int(windows.lengths[part.clip]) - 1 - part.time_at(last)
        other = next(rolls) < gap / settings.longest if gap >= _SPLICED_FROM else gap > room
        if other or gap > room:
            gap = gap if gap >= _SPLICED_FROM else gap + _SPLICED_FROM
            part = _leave(windows, part, gap, settings, rolls, generator)
        else:
            stop = last + gap + min(_draw_run(settings, rolls), room - gap + 1)
            part = replace(part, key=last + gap, stop=stop, truthful_from=last)


def _begin(windows: PoseWindows, settings: KeySettings, rolls: Iterator[float], generator: torch.Generator) -> _Part:
    run = _draw_run(settings, rolls)
    clip, first = (int(each) for each in windows.picker.pick(torch.tensor([run]), generator))
    turn = 2 * math.pi * next(rolls)
    shift = -rotations.rotate_ground(windows.ground[windows.starts[clip] + first], torch.tensor(turn))
    return _Part(clip, 0, first, 0, run, 0, turn, shift)


def _leave(
    windows: PoseWindows,
    part: _Part,
    gap: int,
    settings: KeySettings,
    rolls: Iterator[float],
    generator: torch.Generator,
) -> _Part:
    """Go on with another clip after so many frames, at a distance that is proportional to them."""
    new, last = _begin(windows, settings, rolls, generator), part.stop - 1
    before = windows.starts[part.clip] + part.time_at(last)
    place = rotations.rotate_ground(windows.ground[before], torch.tensor(part.turn)) + part.shift
    way = gap / 30 * settings.speed * next(rolls)
    towards = 2 * math.pi * next(rolls)
    shift = new.shift + place + way * torch.tensor([math.sin(towards), math.cos(towards)])
    start = last + gap
    return replace(new, start=start, key=start, stop=start + new.stop, truthful_from=start, shift=shift)


def _lay_keys(frames: int, settings: KeySettings, longest: float, rolls: Iterator[float]) -> Iterator[tuple[int, int]]:
    """Yield first frames of keys in a window, and one past their last."""
    length = _draw_longest(settings, longest, rolls)
    at = 0 if next(rolls) >= settings.open_ends else min(frames - 1, _draw_gap(length, rolls))
    while at < frames:
        stop = at + _draw_run(settings, rolls)
        yield at, stop
        at = stop - 1 + _draw_gap(length, rolls)
    if next(rolls) >= settings.open_ends:
        yield frames - _draw_run(settings, rolls), frames


def _draw_longest(settings: KeySettings, longest: float, rolls: Iterator[float]) -> float:
    return settings.shortest * (longest / settings.shortest) ** next(rolls)


def _draw_gap(longest: float, rolls: Iterator[float]) -> int:
    return max(2, round(longest * (0.3 + 0.7 * next(rolls))))


def _draw_run(settings: KeySettings, rolls: Iterator[float]) -> int:
    several = next(rolls) < settings.runs
    return 2 + int(next(rolls) * (settings.run - 1)) if several else 1


def _roll(generator: torch.Generator) -> Iterator[float]:
    """Yield numbers from 0 to 1 without an end."""
    while True:
        yield from torch.rand(_ROLLS, generator=generator).tolist()


def _place(motion: PartialMotion, turn: Float[Tensor, "batch frames"], shift: Tensor) -> PartialMotion:
    """Turn every frame about the origin, then shift it over the ground."""
    root = rotations.rotate_about_y(motion.root_position, turn) + rotations.lift_ground(shift)
    return replace(motion, root_position=root, heading=motion.heading + turn)


def _finish(
    motion: PartialMotion,
    known: Tensor,
    truthful: Tensor,
    clip: Tensor,
    parts: PartSettings,
    rolls: Iterator[float],
    generator: torch.Generator,
) -> KeySequences:
    """Mirror half of the sequences, and choose what keys tell."""
    mirrored = torch.rand(len(known), generator=generator) < 0.5
    motion = choose_rows(mirrored, motion.mirrored(), motion)
    return KeySequences(motion, tell_parts(known, motion.heading, parts, rolls), truthful, clip, mirrored)
