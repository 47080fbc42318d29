"""Scene files: who walks along what, how it is filmed and where it goes. TOML, checked before any work."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from pathlib import Path, PurePath
from typing import Annotated

import numpy as np
from pydantic import Field

from mapctl import curves
from mapctl.curves import Curve
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.formats import toml
from mapctl.formats.toml import STRICT
from mapctl.mesh import colours
from scenes.cameras import CameraSettings

_FILMS, _MOTIONS, _REPORTS = (".mp4", ".gif", ".png"), (".bvh", ".npz"), (".json",)
_ENDINGS = (*_FILMS, *_MOTIONS, *_REPORTS)
_MAX_SECONDS = 3600.0

Seconds = Annotated[float, Field(gt=0, le=_MAX_SECONDS)]
Coordinate = Annotated[float, Field(ge=-1000, le=1000)]


@dataclass(frozen=True)
class Actor:
    """One character of a scene."""

    __pydantic_config__ = STRICT

    curve: Annotated[str, Field(min_length=1)]
    """A built-in shape (`circle:4`) or a CSV or SVG file, relative to the scene file."""
    name: Annotated[str, Field(pattern=r"^[\w-]+$")] = ""
    """Used in file names; `actor1`, `actor2`, ... if not given."""
    speed: Annotated[float, Field(gt=0, le=20)] | None = None
    """Speed along the curve, m/s; the controller's own if not given."""
    seconds: Seconds | None = None
    """Duration of the walk, seconds; once along the curve if not given."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of everything random about this actor."""
    colour: str | None = None
    """Torso colour: a name from `mapctl.mesh.colours.ACTORS` or `#rrggbb`; each actor's own if not given."""
    offset: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    """Position of the curve's origin, x and z, metres."""
    turn_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Rotation of the curve about its origin before that, degrees; positive turns +Z toward +X."""
    start_seconds: Annotated[float, Field(ge=0, le=_MAX_SECONDS)] = 0.0
    """Start time, seconds; until then the actor holds its first pose."""


@dataclass(frozen=True)
class SceneDescription:
    """Contents of a scene file."""

    __pydantic_config__ = STRICT

    actors: Annotated[tuple[Actor, ...], Field(min_length=1, max_length=100)]
    """Actors, one [[actors]] table each."""
    outputs: Annotated[tuple[str, ...], Field(min_length=1)]
    """File names: .mp4, .gif, .png of all; .bvh, .npz, one an actor; .json for the report."""
    title: str = ""
    """Description for people."""
    prior: str = "locomotion"
    """Bundled or trained prior that moves the actors."""
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
        scene = toml.read(path, SceneDescription, what="scene file", unknown=_list_allowed_keys)
    except RequestError as error:
        raise FileFormatError(path, f"camera: {error}") from error
    scene = _name_actors(scene)
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
    is_file = PurePath(actor.curve).suffix.lower() in (".csv", ".svg")
    curve = curves.read(folder / actor.curve if is_file else actor.curve)
    points = curve.points.numpy().copy()
    angle = np.radians(actor.turn_deg)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    ground = slice(0, 3, points.shape[1] - 1)
    points[:, ground] = points[:, ground] @ turn.T + np.array(actor.offset)
    return curves.from_points(points, closed=curve.closed)


def _list_allowed_keys(key: Sequence[int | str]) -> str:
    known = {"actors": Actor, "camera": CameraSettings} if len(key) > 1 else {}
    return f"allowed: {', '.join(item.name for item in fields(known.get(str(key[0]), SceneDescription)))}"


def _name_actors(scene: SceneDescription) -> SceneDescription:
    named = [replace(a, name=a.name or f"actor{k}") for k, a in enumerate(scene.actors, start=1)]
    return replace(scene, actors=tuple(named))


def _check(path: str | PathLike[str], scene: SceneDescription) -> None:
    """Check what the types cannot express."""
    names = [actor.name for actor in scene.actors]
    for number, actor in enumerate(scene.actors):
        if names.index(actor.name) != number:
            raise FileFormatError(path, f"actors[{number}].name: {actor.name!r} is taken by another actor")
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
