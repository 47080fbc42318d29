"""docs/inputs/keys.toml as it stands, on the poses that its command makes: nothing jumps into a key or out of it."""

from pathlib import Path

import pytest
from helpers import run

import mapctl
from mapctl.metrics import worst_frame
from mapctl.skeleton import CANONICAL

DOCS = Path(__file__).parents[2] / "docs" / "inputs"
ENDS = [CANONICAL.index(name) for name in ("leftHand", "rightHand", "leftToes", "rightToes")]


def peaks_of(path):
    motion = mapctl.load(path)
    return worst_frame.measure_peaks(motion.joint_positions()[:, ENDS], motion.root_position, float(motion.fps))


@pytest.mark.slow
def test_the_example_of_a_key_file_goes_into_its_keys_and_out_of_them_calmly(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "keys.toml").write_text((DOCS / "keys.toml").read_text())
    assert run("generate", "-o", "poses", "--seconds", 4, "--seed", 1, "--quiet") == 0
    assert run("tween", "keys.toml", "-o", "out.bvh", "--quiet") == 0
    own, made = peaks_of("poses/generated_000.bvh"), peaks_of("out.bvh")
    # A turn and a reach in the time of a stroll: toes go up to 1.6 times as far in a frame as the stroll has them go.
    assert made.step < 1.7 * own.step
    assert made.acceleration < 2 * own.acceleration
