"""`mapctl mcp`: information, shots, denoising, measures and contact sheets as tools of an assistant, over the Model
Context Protocol (modelcontextprotocol.io). Each tool runs the command of its name in this process.
"""

import io
import json
import os
import signal
import tempfile
import threading
import tomllib
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from mapctl.commands.denoise import Denoise
from mapctl.commands.info import Info
from mapctl.commands.measure import Measure
from mapctl.commands.render import Render
from mapctl.commands.run import RunScene
from mapctl.commands.shared import outputs
from mapctl.commands.shared.command import Command, describe_error
from mapctl.errors import MapctlError, RequestError
from mapctl.formats.atomic import write_text
from mapctl.version import __version__
from scenes import scene_file

if TYPE_CHECKING:
    from mcp.server.mcpserver import MCPServer


@dataclass(frozen=True)
class ServeTools(Command):
    """Serve info, shot, denoise, measure and contact_sheet to an assistant, as an MCP server on standard input and
    output, until the assistant closes it."""

    folder: Annotated[Path, arg(metavar="DIR")] = Path()
    """Folder whose files the assistant may read and write; its paths are relative to it."""


_INSTRUCTIONS = """Generate, repair and judge human motion. Lengths are metres (centimetres where a key ends in _cm),
times seconds, angles degrees; Y is up, and a character that faces +Z has its left hand toward +X. Paths are relative to
the served folder. A request that cannot be met is an error, or a constraint with "holds": false and its residual:
change the request and call again."""
_LEFT_OUT = ("request", "versions", "mocap", "timing", "footsteps")  # of a report in short
_MAX_FAULTS = 20
_one_at_a_time = threading.Lock()  # tools run on threads, and commands print to one standard output


def run(command: ServeTools) -> int:
    if not command.folder.is_dir():
        raise RequestError(f"{command.folder} is no folder; name one that exists with --folder")
    os.chdir(command.folder)
    server = build_server()
    for number in (signal.SIGINT, signal.SIGTERM):  # an exception would wait for the threads that read and solve
        signal.signal(number, signal.SIG_DFL)
    server.run("stdio")
    return 0


def build_server() -> "MCPServer":
    """Build the server of the current folder."""
    from mcp.server.mcpserver import MCPServer

    server = MCPServer("mapctl", instructions=_INSTRUCTIONS, version=__version__, log_level="ERROR")
    for tool in (info, shot, denoise, measure, contact_sheet):
        server.add_tool(_refuse_in_a_line(tool))
    return server


def _refuse_in_a_line(tool: Callable[..., Any]) -> Callable[..., Any]:
    """Return the tool with the errors of commands as those of tools: the line that the command prints."""
    from mcp.server.mcpserver.exceptions import ToolError

    @wraps(tool)
    def call(*positional: Any, **named: Any) -> Any:
        try:
            with _one_at_a_time:
                return tool(*positional, **named)
        except (MapctlError, ModuleNotFoundError, OSError) as error:
            raise ToolError(describe_error(error)) from error

    return call


def info(path: str) -> dict[str, Any]:
    """Describe a motion file: rig, joints, unit, axes, frames and seconds; and whether the rig is recognised.

    path: a .bvh, .glb, .vrm, .usd, .fbx, .npz, .c3d ... file; or "example:noisy-walk", a capture that mapctl brings
    along; or "locomotion", the model that shots are walked by, with its speeds in m/s, gaits and styles.
    """
    return _run_for_json(Info(_check_path(path), json=True))


def shot(scene: str, out: str) -> dict[str, Any]:
    """Solve a shot of one or several actors, write its files, and return status and constraints of each actor.

    Every constraint has what was asked and what was got, its unit, "holds", its residual, and where it fails a remedy:
    correct the scene by it. `contact_sheet` shows the motion.

    out: folder for the files that the scene names in `outputs`: .bvh .glb .npz .usd (a motion each, NAME-ACTOR.bvh of
    several actors), .mp4 or .png (all actors) and .json, which is required. The scene is kept as OUT.toml.
    scene: TOML text. One actor walks 5 m along +Z and its left hand is at (0.42, 0.9, 2.6) at 3.1 s for 0.2 s:

    outputs = ["walk.bvh", "walk.json"]
    keep_apart = 0.6                # of several actors: m between hips
    [[actors]]
    curve = "line:5"                # m along +Z; or circle:RADIUS, figure8:RADIUS, wave:AMPLITUDExLENGTH; none: stays
    start = "stand"                 # or walk, or take.bvh:FRAME to go on from a clip
    end = "stand"
    speed = 1.2                     # m/s, if not given 1.2; seconds = 6.0 sets the duration
    offset = [0.0, 0.0]             # x z of the curve's origin, m
    turn_deg = 0                    # of the curve, +Z toward +X
    seed = 0                        # another one is another take
    [[actors.keys]]
    seconds = 3.1
    reach = { leftHand = [0.42, 0.9, 2.6] }     # also rightHand, leftFoot, rightFoot; x y z, m
    hold_seconds = 0.2
    tolerance = 0.0                 # m
    [[actors.keys]]
    seconds = 4.5
    look_at = [-2.5, 1.5, 6.5]      # or of the hips place = [x, z], height = m, facing_deg = degrees from +Z toward +X
    [[obstacles]]
    place = [0.75, 2.7]             # x z, m
    size = [0.6, 1.0]               # of a box; radius = 0.4 of a disc
    """
    out = _check_path(out)
    with suppress(tomllib.TOMLDecodeError):  # which has a line of its own where the scene is read
        _check_strings(tomllib.loads(scene))
    path = Path(f"{out}.toml")
    with outputs.make_folder(path.parent):
        write_text(path, scene)
    described, _ = scene_file.load(path)
    if not described.reports(out):
        raise RequestError(f"{path}: outputs: name a .json too, whose report is returned")
    RunScene(str(path), Path(out), quiet=True).run()
    found = json.loads(described.reports(out)[0].read_text("utf-8"))
    actors = {name: _shorten(report) for name, report in found["actors"].items()}
    motions = {name: [str(each) for each in paths] for name, paths in described.motions(out).items()}
    return {"motions": motions, "films": [str(each) for each in described.films(out)], "actors": actors}


def denoise(path: str, out: str) -> dict[str, Any]:
    """Remove noise, spikes, gaps and sliding feet from a capture, on its own rig; return faults and corrections.

    path: a motion file, as take.bvh; out: the file to write, as clean.bvh. Corrections are centimetres and degrees by
    joint. `measure` the result to see what is left.
    """
    source = Path(_check_path(path))
    if source.is_dir():
        raise RequestError(f"{path} is a folder; name a motion file")
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        Denoise(source, Path(_check_path(out)), report=report, quiet=True).run()
        return _shorten(json.loads(report.read_text("utf-8")))


def measure(path: str) -> dict[str, Any]:
    """Measure a motion file or a folder of them: sliding, jitter, speed and more, beside mocap's own values, and the
    faults of a file by joint and frames, the worst first. Units are in the names: _cm, _m_s, _deg."""
    return _shorten(_run_for_json(Measure(Path(_check_path(path)), json=True)), keep=("mocap",))


def contact_sheet(path: str) -> Any:
    """Draw a motion file as one picture (PNG): poses along the trajectory above a row of stills."""
    from mcp.server.mcpserver import Image

    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "sheet.png"
        Render(Path(_check_path(path)), picture, quiet=True).run()
        return Image(data=picture.read_bytes(), format="png")


def _run_for_json(command: Info | Measure) -> dict[str, Any]:
    """Run a command that prints JSON and return what it printed."""
    with redirect_stdout(io.StringIO()) as printed:
        command.run()
    return json.loads(printed.getvalue())


def _shorten(report: Mapping[str, Any], *, keep: tuple[str, ...] = ()) -> dict[str, Any]:
    """Shorten a report: without what describes the machine and mocap, and with the first faults alone."""
    found = {name: value for name, value in report.items() if name in keep or name not in _LEFT_OUT}
    if len(found.get("faults", ())) > _MAX_FAULTS:
        found |= {"faults": found["faults"][:_MAX_FAULTS], "num_faults": len(found["faults"])}
    return found


def _check_path(text: str) -> str:
    """Return a path of a file below the current folder; RequestError for any other."""
    if ".." in Path(text).parts or not Path.cwd().joinpath(text).is_relative_to(Path.cwd()):
        raise RequestError(f"{text} is outside of the folder that is served; give a path relative to {Path.cwd()}")
    return text


def _check_strings(value: object) -> None:
    """Check all texts in a scene's tables, any of which may be a path; RequestError for one that leaves the folder."""
    if isinstance(value, str):
        _check_path(value)
    elif isinstance(value, Mapping):
        for each in value.values():
            _check_strings(each)
    elif isinstance(value, list):
        for each in value:
            _check_strings(each)
