"""Outputs of every command equal the golden ones: see golden.py."""

import json

import golden
import pytest

LONG = {
    "follow on a rig",
    "generate on",
    "run",
    "denoise with a prior",
    "denoise causal",
    "infill joints",
    "infill by rollouts",
    "tween file",
    "tween variations",
    "tween best",
    "train infiller",
    "train lstm-gmm, paper",
}
"""A quicker one of the same command is compared in any case; `python tests/golden.py` compares all."""
ALL = [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in golden.COMMANDS]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Small models and inputs, and what each command leaves for those after it."""
    result = tmp_path_factory.mktemp("golden")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(result)
        golden.prepare(golden.Path())
    return result


@pytest.mark.parametrize("command", ALL)
def test_outputs_are_as_they_were(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    if command == "measure" and not golden.Path("follow.bvh").exists():
        golden.run_command(golden.COMMANDS["follow"])
    kept = json.loads(golden.FILE.read_text())
    to_the_bit = kept["machine"] == golden.kind_of_machine()
    found = golden.run_command(golden.COMMANDS[command])
    assert golden.differences(found, kept["outputs"][command], to_the_bit=to_the_bit) == []
