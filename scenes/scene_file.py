"""Scene files: actors and their curves, cameras and outputs. TOML, checked before any work."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path, PurePath
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from tyro.conf import arg

from mapctl import curves, formats
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.formats import toml
from mapctl.formats.toml import STRICT
from mapctl.ground import Ground
from mapctl.intent.path import SpeedProfile
from mapctl.intent.shot_keys import ShotKey
from mapctl.mesh import colours
from scenes.cameras import CameraSettings

_FILMS, _MOTIONS, _REPORTS = (".mp4", ".gif", ".webp", ".png"), tuple(formats.WRITERS), (".json",)
_ENDINGS = (*_FILMS, *_MOTIONS, *_REPORTS)
_MAX_SECONDS = 3600.0
_STAY = "line:1"  # of an actor without a curve, which stands at its beginning

Seconds = Annotated[float, Field(gt=0, le=_MAX_SECONDS)]
Seconds0 = Annotated[float, Field(ge=0, le=_MAX_SECONDS)]
Coordinate = Annotated[float, Field(ge=-1000, le=1000)]


@dataclass(frozen=True, kw_only=True)
class ShotOptions:
    """Options shared by a scene's table of an actor and the command `follow`: one character's walk."""

    speed: Annotated[float, Field(gt=0, le=20)] | Annotated[str, Field(min_length=1)] | None = None
    """Speed along the curve, m/s, or `ARC:SPEED,ARC:SPEED`; the controller's own if not given."""
    seconds: Annotated[Seconds | None, arg(metavar="NUMBER")] = None
    """Duration of the walk, seconds; once along the curve if not given."""
    seed: Annotated[int, Field(ge=0, lt=2**63), arg(metavar="N")] = 0
    """Seed of everything random: the same seed gives the same file."""
    gait: Annotated[str | None, arg(metavar="NAME")] = None
    """Gait of the motion, one of the prior's."""
    style: Annotated[str | None, arg(metavar="NAME")] = None
    """Style of the motion, one of the prior's."""
    liveliness: Annotated[float, Field(ge=0, le=1), arg(metavar="0..1")] = 0.5
    """Variety of the walk: 0 is the most probable one, smoother than people walk; 1 is as varied as the prior, farther
    from the curve."""
    start: Annotated[str, Field(min_length=1), arg(metavar="walk|stand|CLIP:FRAME")] = "walk"
    """How it begins: in its stride, standing, or continuing from a frame of a motion file, on that file's rig and at
    its rate; of an actor in the clip's position unless `offset` or `turn_deg` are given."""
    end: Annotated[str, Field(min_length=1), arg(metavar="walk|stand|CLIP:FRAME")] = "walk"
    """How it ends: in its stride, standing, or in a frame of a motion file."""
    loop: bool = False
    """The last frame leads into the first: once around a closed curve."""
    smooth: Annotated[float | None, Field(ge=0, le=10), arg(metavar="METRES")] = None
    """Metres of arc over which the curve is smoothed; 0 for none. If not given, paths that jitter are smoothed over
    0.2."""


@dataclass(frozen=True)
class SceneFootstep:
    """A footstep of an actor, as a report has it."""

    __pydantic_config__ = STRICT

    foot: Literal["left", "right"]
    """Which foot."""
    lift_seconds: Seconds0
    """When it leaves the ground, seconds since the first frame."""
    land_seconds: Seconds0
    """When it lands."""
    toe: tuple[Coordinate, Coordinate]
    """Where its toe joint lands, x and z, metres."""


@dataclass(frozen=True, kw_only=True)
class Actor(ShotOptions):
    """One character of a scene."""

    __pydantic_config__ = STRICT

    curve: Annotated[str, Field(min_length=1)] | None = None
    """A built-in shape (`circle:4`) or a CSV or SVG file, relative to the scene file, or one path of a drawing
    (`drawing.svg#walk`); without one the actor stays."""
    name: Annotated[str, Field(pattern=r"^[\w-]+$")] = ""
    """Used in file names; `actor1`, `actor2`, ... if not given."""
    colour: str | None = None
    """Torso colour: a name from `mapctl.mesh.colours.ACTORS` or `#rrggbb`; each actor's own if not given."""
    rig: Annotated[str, Field(min_length=1)] | None = None
    """Body that moves, on whose rig the motion is written: a clip or a TOML file, relative to the scene file, or a rig
    by name; that of --rig if not given."""
    character: Annotated[str, Field(min_length=1)] | None = None
    """File of a skinned character that is drawn, relative to the scene file; the mannequin if not given."""
    speed_by_time: tuple[tuple[Seconds0, Annotated[float, Field(ge=0, le=20)]], ...] | None = None
    """Speed along the curve by time, pairs of seconds and m/s, zero allowed; instead of `speed`."""
    keys: tuple[ShotKey, ...] = ()
    """Keyframes along the walk, one [[actors.keys]] table each."""
    footsteps: tuple[SceneFootstep, ...] = ()
    """Footsteps, one [[actors.footsteps]] table each: those of a report, moved."""
    offset: tuple[Coordinate, Coordinate] | None = None
    """Position of the curve's origin, x and z, metres; the world's origin if not given."""
    turn_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Rotation of the curve about its origin before that, degrees; positive turns +Z toward +X."""
    start_seconds: Annotated[float, Field(ge=0, le=_MAX_SECONDS)] = 0.0
    """Start time, seconds; until then the actor holds its first pose."""

    @property
    def start_clip(self) -> tuple[str, int] | None:
        """The clip that it continues from, and the frame; None where it begins by itself."""
        return _parse_clip_frame(self.start)

    @property
    def end_clip(self) -> tuple[str, int] | None:
        """The clip that it ends in, and the frame; None where it ends by itself."""
        return _parse_clip_frame(self.end)

    @property
    def fault(self) -> str | None:
        """A fault that the types cannot express, after the key it is of; None without any."""
        if self.speed is not None and self.speed_by_time is not None:
            return "speed_by_time: an actor has a speed or speeds by time, not both"
        try:
            SpeedProfile.parse(str(1.0 if self.speed is None else self.speed))
        except RequestError as error:
            return f"speed: {error}"
        if self.seconds is None and (self.speed_by_time is not None or self.curve is None):
            return "seconds: this key is needed with speed_by_time, and without a curve"
        for name, value in (("start", self.start), ("end", self.end)):
            if value not in ("walk", "stand") and _parse_clip_frame(value) is None:
                return f"{name}: expected walk, stand or CLIP:FRAME, got {value!r}"
        for number, step in enumerate(self.footsteps):
            if step.land_seconds <= step.lift_seconds:
                return f"footsteps[{number}].land_seconds: a foot lands after it is lifted"
        for number, key in enumerate(self.keys):
            if key.fault is not None:
                return f"keys[{number}].{key.fault}"
        return None


def _parse_clip_frame(text: str) -> tuple[str, int] | None:
    clip, colon, frame = text.rpartition(":")
    return (clip, int(frame)) if colon and clip and frame.isdecimal() else None


@dataclass(frozen=True)
class SceneDescription:
    """Contents of a scene file."""

    __pydantic_config__ = STRICT

    actors: Annotated[tuple[Actor, ...], Field(min_length=1, max_length=100)]
    """Actors, one [[actors]] table each."""
    outputs: Annotated[tuple[str, ...], Field(min_length=1)]
    """File names: .mp4, .gif, .webp, .png of all; .bvh, .npz, one an actor; .json for the report."""
    title: str = ""
    """Description for people."""
    prior: str = "locomotion"
    """Bundled or trained prior that moves the actors."""
    weights: Literal["free", "full"] | None = None
    """Set of bundled models, where the command does not name one; the environment's or the full one if not given."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles that all actors walk around, one [[obstacles]] table each."""
    keep_apart: Annotated[float, Field(gt=0, le=10)] | None = None
    """Least distance of the actors' hips, metres; any if not given."""
    ground: Ground | None = None
    """Ground that is not flat: [[ground.boxes]], [[ground.ramps]], [[ground.stairs]], [ground.image]."""
    camera: CameraSettings = field(default_factory=CameraSettings)
    """Camera of the film."""
    size: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]] = (1280, 720)
    """Width and height of the pictures, pixels."""
    fps: Annotated[float, Field(gt=0, le=240)] | None = None
    """Frame rate of the film; the motions' own if not given."""

    def films(self, folder: PathLike[str] | str) -> list[Path]:
        """Return paths of videos and pictures."""
        return self._select_paths(folder, _FILMS)

    def reports(self, folder: PathLike[str] | str) -> list[Path]:
        """Return paths of JSON reports."""
        return self._select_paths(folder, _REPORTS)

    def motions(self, folder: PathLike[str] | str) -> Mapping[str, list[Path]]:
        """Map actor names to their motions' paths; `walk.bvh` becomes `walk-NAME.bvh` where there are several."""
        paths = self._select_paths(folder, _MOTIONS)
        if len(self.actors) == 1:
            return {self.actors[0].name: paths}
        return {a.name: [p.with_name(f"{p.stem}-{a.name}{p.suffix}") for p in paths] for a in self.actors}

    def _select_paths(self, folder: PathLike[str] | str, endings: tuple[str, ...]) -> list[Path]:
        return [Path(folder) / name for name in self.outputs if PurePath(name).suffix.lower() in endings]


def load(path: str | PathLike[str]) -> tuple[SceneDescription, tuple[Curve, ...]]:
    """Load the scene and each actor's curve in the world, checked. FileFormatError names the file and the key."""
    try:
        scene = toml.read(path, SceneDescription, what="scene file")
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error
    named = (replace(a, name=a.name or f"actor{k}") for k, a in enumerate(scene.actors, start=1))
    scene = replace(scene, actors=tuple(named), ground=scene.ground and scene.ground.located(path))
    _check(path, scene)
    placed = []
    for number, actor in enumerate(scene.actors):
        try:
            placed.append(transform_curve(actor, Path(path).parent))
        except MapctlError as error:
            raise FileFormatError(path, f"actors[{number}].curve: {error}") from error
    return scene, tuple(placed)


def transform_curve(actor: Actor, folder: Path) -> Curve:
    """Rotate and move the actor's curve into the world; files are relative to `folder`."""
    text = _STAY if actor.curve is None else actor.curve
    curve = curves.read(text, folder=folder)
    points = curve.points.numpy().copy()
    angle = np.radians(actor.turn_deg or 0.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    ground = slice(0, 3, points.shape[1] - 1)
    points[:, ground] = points[:, ground] @ turn.T + np.array(actor.offset or (0.0, 0.0))
    return curves.from_points(points, closed=curve.closed)


def _check(path: str | PathLike[str], scene: SceneDescription) -> None:
    """Check what the types cannot express."""
    names = [actor.name for actor in scene.actors]
    for number, actor in enumerate(scene.actors):
        if names.index(actor.name) != number:
            raise FileFormatError(path, f"actors[{number}].name: {actor.name!r} is taken by another actor")
        if actor.fault is not None:
            raise FileFormatError(path, f"actors[{number}].{actor.fault}")
        if actor.colour is not None:
            try:
                colours.rgb(actor.colour)
            except MapctlError as error:
                raise FileFormatError(path, f"actors[{number}].colour: {error}") from error
    for number, name in enumerate(scene.outputs):
        if PurePath(name).name != name or name in scene.outputs[:number]:
            raise FileFormatError(path, f"outputs[{number}]: {name!r} must be a file name of its own, without folders")
        if PurePath(name).suffix.lower() not in _ENDINGS:
            raise FileFormatError(path, f"outputs[{number}]: {name!r} must end in one of {', '.join(_ENDINGS)}")
