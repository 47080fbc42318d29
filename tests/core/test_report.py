"""Reports: complete, and JSON that every parser reads."""

import json
import math
from fractions import Fraction

import pytest
import torch

from mapctl import report
from mapctl.motion import Motion
from mapctl.problem.solution import Ledger, LedgerEntry, Outcome, Solution, Status, WindowRecord
from mapctl.skeleton import CANONICAL

FRAMES = 90


def glide(frames: int = FRAMES, speed: float = 1.0) -> Motion:
    """A T-pose that slides along +Z."""
    root = torch.zeros(frames, 3, dtype=torch.float64)
    root[:, 1], root[:, 2] = 0.9, torch.arange(frames) * speed / 30
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(frames, CANONICAL.num_joints, 4)
    return Motion(CANONICAL, Fraction(30), root, still.clone())


def window(frames: int, seconds: float, evaluations: int) -> WindowRecord:
    return WindowRecord(frames, seconds, evaluations, start_energy=2.0, energy=1.0, outcome="converged")


@pytest.fixture
def solution() -> Solution:
    energy, residual = torch.ones(FRAMES), torch.linspace(0, 1, FRAMES)
    ledger = Ledger((LedgerEntry("path", "m", energy, residual),))
    status = Status(Outcome.DONE).with_notes(["too fast"], infeasible=True)
    return Solution(glide(), status, ledger, (window(17, 0.17, 20), window(17, 0.34, 30)))


def test_everything_is_in_it(solution):
    result = report.build_report(
        solution,
        request={"curve": "line:4"},
        seed=3,
        measures={"sway_cm": math.nan},
        prior={"name": "tiny", "licence": "none", "quality": {"mocap": {"sway_cm": {"mean": 1.9}}}},
    )
    result = json.loads(report.to_json(result))
    assert result["request"] == {"curve": "line:4"}
    assert result["seed"] == 3
    assert result["prior"] == {"name": "tiny", "licence": "none"}
    assert result["status"]["notes"] == ["too fast"]
    assert result["status"]["ok"] is False
    assert "too fast" in result["status"]["text"]
    assert result["motion"] == {"frames": FRAMES, "fps": 30.0, "seconds": 3.0}
    assert result["ledger"]["path"]["energy_nats"] == FRAMES
    assert result["ledger"]["path"]["residual_max"] == 1
    assert result["measures"] == {"sway_cm": None}
    assert result["mocap"] == {"sway_cm": {"mean": 1.9}}
    assert {"mapctl", "python", "torch", "numpy", "platform"} <= result["versions"].keys()


def test_timing_is_for_each_delivered_frame(solution):
    timing = report.summarise_timing(solution.windows, seconds=2.0)
    assert timing["frame_ms_p50"] == pytest.approx(15)  # between 10 ms in one window and 20 ms in the other
    assert timing["frame_ms_p99"] == pytest.approx(20)
    assert timing["frame_ms_mean"] == pytest.approx(15)
    assert timing["evaluations_per_frame"] == pytest.approx(50 / 34)
    assert (timing["seconds"], timing["windows"], timing["threads"]) == (2.0, 2, torch.get_num_threads())
    assert "late_frames" not in timing
