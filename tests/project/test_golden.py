"""What every command writes and prints is what it was: see golden.py."""

import json

import golden
import pytest


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Fingerprints of the files that each command makes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("golden"))
        golden.prepare(golden.Path())
        return dict(golden.outputs())


@pytest.mark.parametrize("command", golden.COMMANDS)
def test_outputs_are_what_they_were(command, found):
    kept = json.loads(golden.FILE.read_text())
    to_the_bit = kept["machine"] == golden.kind_of_machine()
    assert golden.differences(found[command], kept["outputs"][command], to_the_bit=to_the_bit) == []


def test_a_change_is_seen_in_bits_and_in_numbers(tmp_path):
    file = tmp_path / "a.csv"
    prints = []
    for last in ("3.0", "3.0000001", "9.0"):
        file.write_text(f"1.0,2.0,{last}")
        prints.append({"a.csv": golden.fingerprint(file)})
    same, nearly, other = prints
    assert golden.differences(same, same, to_the_bit=True) == []
    assert golden.differences(nearly, same, to_the_bit=True)
    assert golden.differences(nearly, same, to_the_bit=False) == []
    assert golden.differences(other, same, to_the_bit=False)
    assert golden.differences({}, same, to_the_bit=False) == ["a.csv: not made"]
