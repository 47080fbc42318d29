"""scenes: films of motions and scripted scenes.

`scenes.film.film(actors, "walk.mp4")` films any motions; `scenes.load("crossing.toml")` reads a scene file.
"""

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.errors import RequestError
from mapctl.lazy import import_lazily

if TYPE_CHECKING:
    from scenes import film as film
    from scenes.cameras import CameraSettings as CameraSettings
    from scenes.renderers import back_end as back_end
    from scenes.scene_file import Actor as Actor
    from scenes.scene_file import SceneDescription as SceneDescription
    from scenes.scene_file import load as load
    from scenes.stage import Shot as Shot

# Graphics libraries take seconds to import and may be missing, so public names arrive on first use.
_HOMES = {
    "CameraSettings": "scenes.cameras",
    "Actor": "scenes.scene_file",
    "SceneDescription": "scenes.scene_file",
    "load": "scenes.scene_file",
    "Shot": "scenes.stage",
    "back_end": "scenes.renderers",
}
__getattr__, __dir__ = import_lazily(__name__, _HOMES, {"film": "scenes.film"}, ["find_scene", "list_scenes"])


def list_scenes() -> tuple[str, ...]:
    """List names of the scenes that come with mapctl."""
    return tuple(sorted(p.name.removesuffix(".toml") for p in files("scenes").iterdir() if p.name.endswith(".toml")))


def find_scene(scene: str) -> Path:
    """Find the path of a scene file or of a ready scene by name; RequestError lists these if there is neither."""
    if Path(scene).is_file() or Path(scene).suffix:
        return Path(scene)
    if scene not in list_scenes():
        raise RequestError(f"no scene file {scene!r}; ready scenes: {', '.join(list_scenes())}")
    return Path(str(files("scenes") / f"{scene}.toml"))
