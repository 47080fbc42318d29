"""Actors of a film, what they are requested, and marks on the ground, frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch

from mapctl.contacts import detect_contacts
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.ground import Ground
from mapctl.joint_names import Side
from mapctl.mesh import colours
from mapctl.mesh.mannequin import Body
from mapctl.mesh.primitives import Array, Surface, merge_surfaces
from mapctl.motion import Motion
from scenes import overlays
from scenes.cameras import CameraSettings, View, compute_views
from scenes.drawn_character import DrawnMotion
from scenes.renderers import Content, Figure

_RIBBON_STEP = 0.06
_LEAST_SECONDS = 0.3  # for which what is requested at one moment is shown strongly
_FAINT = 0.25  # opacity of marks before and after their time
_TINT, _SHELL = 0.75, 0.012  # share of the colour of all that is requested in a pose's; metres around its body


@dataclass(frozen=True, eq=False)
class Mark:
    """A thing to reach, to look at, or to be at."""

    surface: Surface
    seconds: tuple[float, float]
    """From when to when it is requested, seconds since the actor's first frame."""


@dataclass(frozen=True, eq=False)
class Targets:
    """All that an actor is requested, beside its curve."""

    marks: Sequence[Mark] = ()
    poses: Sequence[Motion] = ()
    """Poses, each one frame in its place, of the actor's skeleton."""


class Shot(NamedTuple):
    """One actor of a film; a plain tuple (motion, curve, colour, start) serves as well."""

    motion: Motion
    """Motion on any rig and at any frame rate."""
    curve: Curve | None = None
    """Curve that the actor was asked to follow."""
    colour: str | None = None
    """Name from `mapctl.mesh.colours.ACTORS` or `#rrggbb`; each actor's own if None."""
    start_seconds: float = 0.0
    """Start of the motion, seconds; until then the actor holds its first pose."""
    targets: Targets = Targets()
    """Targets of the actor beside the curve."""
    drawn: DrawnMotion | None = None
    """The motion on a character that is drawn with its own mesh; a mannequin is drawn if None."""


@dataclass(frozen=True, eq=False)
class StagedActor:
    """An actor prepared for a film: its body, and its ribbons, contacts and marks computed once."""

    body: Body
    target: Surface | None
    trail: Surface
    planted: Array
    """(frames, feet) whether the foot is planted."""
    start: int
    """Film frame of the motion's first frame."""
    marks: Sequence[tuple[Surface, int, int]]
    """Shapes, and the film's first and last frame in which they are requested."""
    poses: Sequence[Figure]
    """Bodies in the poses that are requested."""

    def frame(self, film_frame: int) -> int:
        """Return the motion's frame at a film's; the first before it starts and the last after it ends."""
        return min(max(film_frame - self.start, 0), self.body.num_frames - 1)

    def marks_at(self, film_frame: int) -> list[Surface]:
        """Return the marks in a frame of the film: strong while they are requested, faint before and after."""
        faint = np.array([1.0, 1.0, 1.0, _FAINT])
        return [
            mark if first <= film_frame <= last else replace(mark, rgba=mark.rgba * faint)
            for mark, first, last in self.marks
        ]


class Stage:
    """All actors and props on their ground. `fps` resamples every motion; by default the first actor's rate holds."""

    def __init__(
        self,
        shots: Sequence[Shot],
        fps: Fraction | float | None = None,
        props: Sequence[Surface] = (),
        ground: Ground | None = None,
    ):
        if not shots:
            raise RequestError("a film needs at least one actor")
        self.fps = Fraction(fps or shots[0].motion.fps).limit_denominator(100_000)
        self.players = [_prepare_actor(shot, k, len(shots), self.fps, ground) for k, shot in enumerate(shots)]
        self.num_frames = max(p.start + p.body.num_frames for p in self.players)
        self._veils = [figure for player in self.players for figure in player.poses]
        targets = [player.target for player in self.players if player.target is not None]
        self._curves = [target.vertices for target in targets]
        paths = [player.body.anatomy.hips_world for player in self.players]
        grid = overlays.build_grid(np.concatenate([*paths, *self._curves])[:, [0, 2]])
        terrain = [] if ground is None else [overlays.build_ground(ground)]
        self._still = merge_surfaces([grid, *terrain, *(overlays.drape(target, ground) for target in targets), *props])
        self._ground = ground

    def content(self, film_frame: int) -> Content:
        figures = [Figure(player.body, player.frame(film_frame)) for player in self.players]
        trails = [overlays.cut_ribbon(p.trail, f.frame + 1) for p, f in zip(self.players, figures, strict=True)]
        marks = [_build_contact_marks(p, f.frame) for p, f in zip(self.players, figures, strict=True)]
        asked = [mark for player in self.players for mark in player.marks_at(film_frame)]
        flat = [overlays.drape(each, self._ground) for each in (*trails, *(m for m in marks if m is not None))]
        return Content([self._still, *flat, *asked], figures, self._veils, self._ground)

    def compose_ghosts(self, film_frames: Sequence[int]) -> Content:
        """Compose all actors at several times, earlier ones paler, with the whole trails and all that is requested."""
        fades = np.linspace(0.62, 0.0, len(film_frames)) if len(film_frames) > 1 else [0.0]
        moments = list(zip(film_frames, fades, strict=True))
        figures = [
            Figure(player.body, frame, fade)
            for player in self.players
            # A later ghost replaces one in the same pose: an actor that waits or has arrived.
            for frame, fade in {player.frame(at): float(fade) for at, fade in moments}.items()
        ]
        trails = [overlays.drape(player.trail, self._ground) for player in self.players]
        marks = [mark for player in self.players for mark, _, _ in player.marks]
        return Content([self._still, *trails, *marks], figures, self._veils, self._ground)

    def views(self, settings: CameraSettings, size: tuple[int, int]) -> list[View]:
        """Return one view a frame that shows all actors, and all curves unless the camera follows."""
        index = [[p.frame(k) for k in range(self.num_frames)] for p in self.players]
        bodies = [p.body.seen[i] for p, i in zip(self.players, index, strict=True)]
        hips = [p.body.anatomy.hips_world[i] for p, i in zip(self.players, index, strict=True)]
        seen = np.concatenate(bodies, axis=1)
        if settings.kind != "follow":
            seen = np.concatenate([seen.reshape(-1, 3), *self._curves])[None]
        return compute_views(settings, seen, np.mean(hips, axis=0), fps=float(self.fps), size=size)


def _prepare_actor(shot: Shot, number: int, count: int, fps: Fraction, ground: Ground | None) -> StagedActor:
    if not 0 <= shot.start_seconds < 3600:
        raise RequestError(f"start_seconds must be from 0 to 3600, got {shot.start_seconds:g}")
    colour = colours.rgb(shot.colour or colours.default_colour(number))
    motion = shot.motion.resample(fps)
    body = Body.of(motion, colour) if shot.drawn is None else shot.drawn.build_body(fps, colour)
    # One actor has a red curve and a yellow trail as in Wang et al. 2019; among several both have the actor's colour.
    target, trod = colours.rgb(colours.TARGET), colours.rgb(colours.TRAIL)
    if count > 1:
        target, trod = colours.blend_colours(colour, colours.rgb(colours.BACKGROUND), 0.62), colour
    path = body.anatomy.hips_world[:, [0, 2]]
    balls = [foot.ball for foot in body.anatomy.feet]
    planted = np.zeros((body.num_frames, len(balls)), bool)
    if len(balls) == 2:
        world = torch.from_numpy(body.anatomy.points.world[:, balls]).clone()
        if ground is not None:
            world[..., 1] -= ground.height(world[..., ::2])
        planted = detect_contacts(world, float(fps)).numpy()
    marks = []
    for mark in shot.targets.marks:
        early, late = mark.seconds
        margin = max(0.0, _LEAST_SECONDS - (late - early)) / 2
        first, last = (round((shot.start_seconds + at) * fps) for at in (early - margin, late + margin))
        marks.append((mark.surface, first, last))
    return StagedActor(
        body,
        None if shot.curve is None else _build_curve_ribbon(shot.curve, target),
        overlays.build_ribbon(path, width=0.05, rgb=trod, height=overlays.TRAIL_HEIGHT),
        planted,
        round(shot.start_seconds * fps),
        marks,
        _build_figures(shot.targets.poses, motion, shot.drawn),
    )


def _build_curve_ribbon(curve: Curve, rgb: Array) -> Surface:
    """Build a band along the curve; its dense points are thinned to what a picture shows."""
    points = curve.points.detach().cpu().numpy()
    keep = max(1, round(_RIBBON_STEP / max(curve.length / (len(points) - 1), 1e-6)))
    thin = np.concatenate([points[:-1:keep], points[-1:]])
    return overlays.build_ribbon(thin, width=0.11, rgb=rgb, height=overlays.TARGET_HEIGHT)


def _build_contact_marks(player: StagedActor, frame: int) -> Surface | None:
    """Build a disc under the ball of every planted foot, in its side's colour."""
    feet = [foot for foot, stands in zip(player.body.anatomy.feet, player.planted[frame], strict=True) if stands]
    if not feet:
        return None
    centres = player.body.anatomy.points.world[frame, [foot.ball for foot in feet]][:, [0, 2]]
    sides = [colours.rgb(colours.LEFT if foot.side is Side.LEFT else colours.RIGHT) for foot in feet]
    return overlays.build_discs(centres, np.array(sides), radius=0.1 * player.body.anatomy.scale)


def _build_figures(poses: Sequence[Motion], motion: Motion, drawn: DrawnMotion | None) -> list[Figure]:
    if not poses:
        return []
    if drawn is not None:
        bodies = [drawn.put_on(pose).build_body(pose.fps, colours.rgb(colours.TARGET)) for pose in poses]
        return [Figure(body, 0, _TINT, toward=colours.TARGET, shell=_SHELL) for body in bodies]
    # A body's shoes are as its whole motion shows them flat; a pose alone may stand on its toes.
    whole = reduce(lambda joined, pose: joined.join(replace(pose, fps=motion.fps)), poses, motion)
    body = Body.of(whole, colours.rgb(colours.TARGET))
    numbers = range(motion.num_frames, whole.num_frames)
    return [Figure(body, number, _TINT, toward=colours.TARGET, shell=_SHELL) for number in numbers]
