"""`mapctl run`: a scripted scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class RunScene(ModelCommand, options.ReadOptions):
    """A scripted scene of several actors, from a TOML file or a ready one by name."""

    scene: Positional[Annotated[str, arg(metavar="SCENE.toml")]]
    """The scene file, or the name of a scene that comes with mapctl (`mapctl info` lists them)."""
    out: options.OutFolder = Path()
    """Folder for the scene's outputs; made if it does not exist."""
    rig: options.OutRig = "canonical"
    """Body of the actors whose `rig` the scene file does not give: the canonical one, or that of a clip, on whose rig
    they are written; or a rig by name or TOML file, whose joints get the canonical bones."""
    strict: bool = False
    """Exit with status 3 where not all that was asked of every actor holds."""
    quiet: bool = False
    """No summary and no progress bar."""
