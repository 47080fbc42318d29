"""Each script runs on two short clips and prints a table."""

from importlib import import_module

import pytest

RUNS = {
    "inbetween": ["--windows", "1"],
    "inbetween --lafan": ["--windows", "1"],
    "denoise": ["--seconds", "2.5"],
    "follow": ["--walks", "1"],
    "steer": ["--commands", "6", "--stand", "3"],
    "generate": ["--seconds", "2"],
    "shots": ["--shots", "1"],
    "speed": ["--seconds", "2.5"],
}


@pytest.mark.parametrize("name", [pytest.param(each, marks=[pytest.mark.slow] * (each != "generate")) for each in RUNS])
def test_a_script_prints_one_table(data, name, capsys):
    script, *flags = name.split()
    import_module(script).main(["--clips", str(data), "--count", "2", *flags, *RUNS[name]])
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("| ---") for line in lines) == 1
    assert len({line.count("|") for line in lines if line.startswith("|")}) == 1
    assert "2 clips, 0 skipped" in lines[-2]
