"""`mapctl bench`: cost of the solver, of following and of steering."""

import json

import pytest
from helpers import run

from mapctl.commands import bench


@pytest.mark.slow
def test_cost_is_measured(prior, monkeypatch, capsys):
    monkeypatch.setattr(bench, "SIZES", bench.Sizes(repeats=1, candidates=(1,), seconds=(1.0,), steps=3))
    assert run("bench", "--prior", prior, "--live", prior, "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    evaluation, follow, steer = rows
    assert evaluation["times_faster"] > 0
    assert follow["ms_per_frame"] > 0
    assert steer["ms_per_frame"] > 0
