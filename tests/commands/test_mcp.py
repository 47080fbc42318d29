"""`mapctl mcp`: what an assistant calls, gets and is refused, through the client of the SDK."""

import asyncio
import base64
import json
import os
import shutil
import sys
import textwrap
from pathlib import Path

import pytest
from helpers import run, walk
from tiny_weights import save_tiny_weights

from priors import weight_sets

mcp = pytest.importorskip("mcp", reason="needs mcp: pip install 'mapctl[mcp]'")

from mapctl.commands.mcp import build_server, shot  # noqa: E402
from scenes import scene_file  # noqa: E402

SCENE = 'outputs = ["a.npz", "a.json"]\n[[actors]]\ncurve = "line:0.5"\n'
REACH = "[[actors.keys]]\nseconds = 0.2\nreach = {{ leftHand = [{x}, 1.2, 0.3] }}\n"


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Tiny weights, and a folder of clips."""
    folder = tmp_path_factory.mktemp("served")
    save_tiny_weights(folder / "weights" / "free", models=weight_sets.list_models("free"))
    (folder / "clips").mkdir()
    walk(40).save(folder / "clips" / "in.bvh")
    return folder


@pytest.fixture
def here(saved, tmp_path, monkeypatch):
    """The folder that is served, as the current one."""
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    monkeypatch.setenv("MAPCTL_WEIGHTS", "free")
    monkeypatch.setenv(weight_sets.FOLDER_VARIABLE, str(saved / "weights"))
    served = tmp_path / "served"
    shutil.copytree(saved / "clips", served)
    shutil.copytree(saved / "clips", served / "clips")
    monkeypatch.chdir(served)
    return served


def call(tool: str, **arguments: object):
    """The result of one tool, from a server in this process."""

    async def ask():
        async with mcp.Client(build_server()) as client:
            return await client.call_tool(tool, arguments)

    return asyncio.run(ask())


def answer(tool: str, **arguments: object) -> dict:
    result = call(tool, **arguments)
    assert not result.is_error, result.content[0].text
    assert json.loads(result.content[0].text) == result.structured_content
    return result.structured_content


def refusal(tool: str, **arguments: object) -> str:
    result = call(tool, **arguments)
    assert result.is_error
    return result.content[0].text.removeprefix(f"Error executing tool {tool}: ")


def test_the_tools_are_described_and_take_texts():
    async def ask():
        async with mcp.Client(build_server()) as client:
            return (await client.list_tools()).tools

    tools = {tool.name: tool for tool in asyncio.run(ask())}
    assert tools.keys() == {"info", "shot", "denoise", "measure", "contact_sheet"}
    assert all(tool.description for tool in tools.values())
    taken = {name: set(tool.input_schema["properties"]) for name, tool in tools.items()}
    assert (taken["shot"], taken["denoise"], taken["info"]) == ({"scene", "out"}, {"path", "out"}, {"path"})


def test_the_scene_of_the_description_is_one(tmp_path):
    _, _, example = textwrap.dedent(shot.__doc__).partition("outputs = ")
    path = tmp_path / "example.toml"
    path.write_text(f"outputs = {example}")
    scene, (curve,) = scene_file.load(path)
    assert curve.length == pytest.approx(5.0)
    assert [bool(key.reach) for key in scene.actors[0].keys] == [True, False]
    assert len(scene.obstacles) == 1


def test_information_and_measures_are_those_of_the_commands(here, capsys):
    for words, found in (
        (("info", "in.bvh", "--json"), answer("info", path="in.bvh")),
        (("measure", "in.bvh", "--json"), answer("measure", path="in.bvh")),
        (("measure", "clips", "--json"), answer("measure", path="clips")),
    ):
        assert run(*words) == 0
        assert found == json.loads(capsys.readouterr().out)


def test_a_denoised_capture_is_written_and_its_report_is_that_of_the_command(here):
    found = answer("denoise", path="in.bvh", out="clean.bvh")
    assert run("denoise", "in.bvh", "-o", "again.bvh", "--report", "again.json", "--quiet") == 0
    assert (here / "clean.bvh").read_bytes() == (here / "again.bvh").read_bytes()
    report = json.loads((here / "again.json").read_text())
    assert found["correction_cm"] == report["correction_cm"]
    assert found["measures"] == report["measures"]
    assert found["faults"] == report["faults"][:20]


def test_a_shot_is_solved_and_its_constraints_come_back_with_residuals(here):
    found = answer("shot", scene=SCENE + REACH.format(x=0.3), out="shots/first")
    assert found["motions"] == {"actor1": ["shots/first/a.npz"]}
    assert (here / "shots/first/a.npz").exists()
    report = json.loads((here / "shots/first/a.json").read_text())["actors"]["actor1"]
    actor = found["actors"]["actor1"]
    assert actor["constraints"] == report["constraints"]
    assert {"leftHand at 0.2 s": "cm"}.items() <= {c["constraint"]: c["unit"] for c in actor["constraints"]}.items()
    assert actor["status"]["text"] == report["status"]["text"]
    assert run("run", "shots/first.toml", "-o", "again", "--quiet") == 0
    assert (here / "again/a.npz").read_bytes() == (here / "shots/first/a.npz").read_bytes()


def test_a_contact_sheet_is_a_picture(here):
    pytest.importorskip("PIL")
    (image,) = call("contact_sheet", path="in.bvh").content
    assert image.mime_type == "image/png"
    assert base64.b64decode(image.data).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("tool", "arguments", "words"),
    [
        ("info", {"path": "no.bvh"}, "info no.bvh"),
        ("measure", {"path": "no.bvh"}, "measure no.bvh"),
        ("denoise", {"path": "in.bvh", "out": "in.bvh"}, "denoise in.bvh -o in.bvh"),
        ("contact_sheet", {"path": "no.bvh"}, "render no.bvh -o a.png"),
        ("shot", {"scene": SCENE + "sped = 1.0\n", "out": "s"}, "run s.toml"),
        ("shot", {"scene": "outputs = [", "out": "s"}, "run s.toml"),
        ("shot", {"scene": SCENE + REACH.format(x=1.9), "out": "s"}, "run s.toml"),
    ],
)
def test_a_refusal_is_the_line_that_the_command_prints(here, capsys, tool, arguments, words):
    line = refusal(tool, **arguments)
    assert run(*words.split()) == 2
    assert capsys.readouterr().err == f"mapctl: {line}\n"


def test_a_reach_that_is_too_far_is_refused_with_its_distance(here):
    assert "is to be 1.9 m from where the walk is then" in refusal("shot", scene=SCENE + REACH.format(x=1.9), out="s")


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("info", {"path": "../secret.bvh"}),
        ("measure", {"path": "/etc"}),
        ("contact_sheet", {"path": "clips/../../secret.bvh"}),
        ("denoise", {"path": "in.bvh", "out": "../out.bvh"}),
        ("denoise", {"path": "/secret.bvh", "out": "out.bvh"}),
        ("shot", {"scene": SCENE, "out": "../out"}),
        ("shot", {"scene": SCENE.replace("line:0.5", "/secret.csv"), "out": "s"}),
        ("shot", {"scene": SCENE + 'start = "../secret.bvh:3"\n', "out": "s"}),
        ("shot", {"scene": SCENE + '[[actors.keys]]\nseconds = 1\npose = "../secret.bvh"\n', "out": "s"}),
    ],
)
def test_paths_outside_of_the_folder_are_refused(here, tool, arguments):
    before = sorted(here.parent.rglob("*"))
    assert "is outside of the folder that is served" in refusal(tool, **arguments)
    assert sorted(here.parent.rglob("*")) == before


def test_paths_inside_may_be_absolute(here):
    assert answer("info", path=str(here / "in.bvh"))["frames"] == 40


def test_a_scene_without_a_report_and_a_folder_to_denoise_are_refused(here):
    assert "name a .json too" in refusal("shot", scene=SCENE.replace(', "a.json"', ""), out="s")
    assert "clips is a folder" in refusal("denoise", path="clips", out="clean")


@pytest.mark.slow
def test_the_command_serves_a_folder_over_standard_input_and_output(here):
    """As a client starts it; what commands print does not get between the messages."""
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), *filter(None, sys.path)])}
    words = ["-m", "mapctl", "mcp", "--folder", str(here / "clips")]
    server = mcp.StdioServerParameters(command=sys.executable, args=words, env=environment, cwd=here)

    async def ask():
        async with mcp.Client(mcp.stdio_client(server)) as client:
            info = await client.call_tool("info", {"path": "in.bvh"})
            return info, await client.call_tool("denoise", {"path": "in.bvh", "out": "clean.bvh"})

    info, denoised = asyncio.run(ask())
    assert info.structured_content["frames"] == 40
    assert denoised.structured_content["status"]["ok"]
    assert (here / "clips" / "clean.bvh").exists()


def test_a_folder_that_is_not_there_is_refused(fails):
    assert "mapctl: nowhere is no folder" in fails("mcp", "--folder", "nowhere")
