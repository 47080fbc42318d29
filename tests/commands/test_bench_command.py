"""`mapctl bench`: a sub-command a table, each with its own options; and every command's work is found."""

import json
import math
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
import torch
from helpers import run, walk

from controllers.benchmarks.shots import fulfilment
from controllers.benchmarks.solver import SpeedBenchmarkSettings, benchmark_speed
from mapctl import cli
from mapctl.commands import COMMANDS, bench
from mapctl.commands.shared.command import Command


@pytest.mark.parametrize("words", [[], ["--json"], ["--prior", "general"], ["speed", "--json"]], ids=" ".join)
def test_speed_is_meant_where_no_table_is_named(words):
    found = cli.parse(["bench", *words])
    assert isinstance(found, bench.Speed)
    assert found.json is ("--json" in words)
    assert found.prior == ("general" if "general" in words else "locomotion")


def test_tables_have_options_of_their_own():
    found = cli.parse(["bench", "tween", "--data", "mocap", "--count", "10", "--prior", "general"])
    assert found == bench.Tween(data=Path("mocap"), count=10, prior="general")
    assert cli.parse(["bench", "live", "--minutes", "2"]) == bench.Live(minutes=2.0)


@pytest.mark.parametrize("name", bench.TABLES)
def test_every_table_has_help(name, capsys):
    with pytest.raises(SystemExit) as stop:
        run("bench", name, "--help")
    assert stop.value.code == 0
    assert f"mapctl bench {name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["speed", "--count", "3"], "--count 3 (see mapctl bench speed --help)"),
        (["tween"], "--data"),
        (["tween"], "mapctl bench tween --help"),
        (["fly"], "speed, ablation, follow"),
        (["fly"], "(see mapctl bench --help)"),
        (["tween", "--data", "."], "does not hold the clips kept from training"),
        (["speed", "--beside", "docs"], "docs is no checkout of mapctl"),
        (["speed", "--beside", "docs", "--turns", "0"], "--turns must be 1 or more"),
        (["live", "--minutes", "0"], "--minutes must be more than 0"),
        (["live", "--characters", "1,two"], "--characters must be numbers from 1 to 64"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_impossible_tables(fails, words, said):
    assert said in fails("bench", *words)


@pytest.mark.slow
def test_speed_is_measured(prior, monkeypatch, capsys):
    short = SpeedBenchmarkSettings(repeats=1, particles=(1,), lengths=(1.0,))
    monkeypatch.setattr("mapctl.commands.bench.speed.benchmark_speed", partial(benchmark_speed, settings=short))
    assert run("bench", "--prior", prior, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bench"] == "speed"
    assert [row["what"] for row in told["rows"]] == [
        "energy and gradient, 34 frames, 1 candidates",
        "follow a circle for 1 s",
    ]


@pytest.mark.slow
def test_versions_take_turns(capsys):
    """This version beside itself, as somebody would time two."""
    root = Path(cli.__file__).parent.parent
    assert run("bench", "speed", "--beside", str(root), "--turns", "2", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["what"].split(",")[0] for row in rows] == ["steer", "follow circle:4", "start-up of follow"]
    assert all(0.3 < row["times_faster"] < 3 and row["this"] > 0 for row in rows)


@pytest.mark.parametrize(
    "kind", [kind for kind in (*COMMANDS.values(), *bench.TABLES.values()) if issubclass(kind, Command)]
)
def test_work_is_found(kind):
    if kind is not bench.Bench:  # which only has sub-commands
        assert callable(import_module(kind.work or f"{kind.__module__}.run").run)


@pytest.mark.slow
def test_live_targets_are_measured(prior, monkeypatch, capsys):
    monkeypatch.setattr("controllers.benchmarks.live_targets._SECONDS", 1.5)
    assert run("bench", "steer", "--targets", "--count", 1, "--prior", prior, "--json") == 0
    rows = {row["targets"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert list(rows) == ["walking on", "reaching in passing", "reaching, standing", "round a disc"]
    assert rows["walking on"]["within_1_cm_percent"] is None
    assert rows["reaching, standing"]["held_s_mean"] >= 0
    assert rows["round a disc"]["clearance_cm_least"] > 0
    assert rows["walking on"]["toe_mps_max"] == rows["reaching in passing"]["toe_mps_max"], "legs walk on as they do"


@pytest.mark.slow
def test_shots_are_told_from_mocap_as_a_percentage():
    """By the real classifier, on motions that are known: those that slide are told apart, the same ones are not."""
    mocap = [walk(300).slice(start, start + 90) for start in range(0, 200, 10)]
    sliding = [replace(clip, root_position=clip.root_position[:1].expand(90, 3)) for clip in mocap]
    told, same = (fulfilment._tell_apart(motions, mocap, 0)["told_apart_pct"] for motions in (sliding, mocap))
    assert told > 90 > same


def test_a_body_that_glides_over_the_floor_shows_a_fault():
    """It plants no toe, and the speed of none is no number that is within a limit."""
    first = walk(90)
    quats = first.local_quat_xyzw[:1].expand(90, -1, -1)
    standing = replace(first, root_position=first.root_position[:1].expand(90, 3), local_quat_xyzw=quats)
    ahead = 0.1 * torch.arange(90.0, dtype=torch.float64)[:, None] * torch.tensor([0.0, 0.0, 1.0]).double()
    gliding = replace(standing, root_position=standing.root_position + ahead)
    assert math.isnan(fulfilment._measure([gliding])["planted_cm_s"])
    assert fulfilment._shows_fault(gliding)
    assert not fulfilment._shows_fault(standing)
    assert fulfilment._measure([gliding, first])["planted_cm_s"] == fulfilment._measure([first])["planted_cm_s"]
