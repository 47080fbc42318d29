"""Following a curve with an untrained density: the contract of the job, not the quality of the walk."""

import math

import pytest
import torch
from helpers import generator, tiny_density

import controllers
from controllers.shots.walk import FollowSettings, check_path
from mapctl import curves
from mapctl.errors import RequestError
from mapctl.features import encode
from mapctl.intent.path import PathRequest, SpeedProfile
from mapctl.kinematics import heading
from mapctl.problem.receding_horizon import HorizonSettings
from mapctl.problem.solution import Outcome
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import DataLimits
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget

DENSITY = tiny_density()
QUICK = FollowSettings(
    window=HorizonSettings(frames=10, overlap=4, past=12),
    method=LatentNoiseSolver(rounds=1, budget=Budget(evaluations=5)),
)
ABLE = DataLimits(slowest=0.5, fastest=2.0, turn_rate=1.5)
HILL = torch.stack(
    [torch.zeros(50), 0.9 + 0.02 * torch.linspace(0, 6, 50).sin(), torch.linspace(0, 3, 50)], -1
).double()


def follow(curve, *, seed=0, **options):
    return controllers.follow(DENSITY, curve, generator=generator(seed), **{"settings": QUICK, **options})


@pytest.mark.parametrize(
    "curve", [curves.circle(radius=2), curves.s(length=3), curves.from_points(HILL)], ids=["circle", "s", "hill"]
)
def test_a_walk_starts_on_the_curves_first_point_going_along_it(curve):
    solution = follow(curve, seconds=1.0, speed=1.2)
    motion = solution.motion
    assert (motion.num_frames, motion.fps, motion.skeleton) == (30, 30, CANONICAL)
    start = curve.point(0.0)[[0, -1]]
    torch.testing.assert_close(motion.root_position[0, ::2], start, atol=1e-5, rtol=0)
    way = motion.root_position[15, ::2] - start
    along = curve.point(0.6)[[0, -1]] - start
    assert float(way @ along / way.norm() / along.norm()) > math.cos(0.3)
    facing = float(heading(motion.local_quat_xyzw[0, 0]))
    assert abs(math.remainder(facing - curve.start_heading, 2 * math.pi)) < 0.6
    assert all(len(entry.energy) == 29 for entry in solution.ledger.entries)
    assert {entry.name for entry in solution.ledger.entries} == {"noise", "path", "footing"}
    assert solution.features.shape[0] == 30
    torch.testing.assert_close(encode(motion)[0][1:, :66], solution.features[1:, :66].double(), atol=1e-5, rtol=0)


def test_a_curve_that_rises_is_refused():
    hills = curves.from_points(HILL - HILL.new_tensor([0.0, 0.9, 0.0]))
    with pytest.raises(RequestError, match="the ground is level: give x,z"):
        follow(hills)


def test_the_same_seed_gives_the_same_bytes_and_other_seeds_other_walks(tmp_path):
    curve = curves.circle(radius=2)
    for name, seed in enumerate((1, 1, 2, 3, 4)):
        follow(curve, seconds=0.5, seed=seed).motion.save(tmp_path / f"{name}.bvh")
    written = [(tmp_path / f"{name}.bvh").read_bytes() for name in range(5)]
    assert written[0] == written[1]
    assert len(set(written)) == 4


def interrupt_at(frames):
    """Progress that presses Ctrl-C once so many frames are done."""

    def progress(done, total):
        if done >= frames:
            raise KeyboardInterrupt

    return progress


def test_an_interrupted_walk_keeps_what_was_solved():
    whole = follow(curves.circle(radius=2), seconds=1.0)
    solution = follow(curves.circle(radius=2), seconds=1.0, progress=interrupt_at(10))
    assert solution.status.outcome is Outcome.INTERRUPTED
    assert solution.status.text.startswith("interrupted; what was solved until then is kept")
    assert solution.motion.num_frames == 13
    torch.testing.assert_close(solution.motion.root_position, whole.motion.root_position[:13])
    assert all(len(entry.energy) == 12 for entry in solution.ledger.entries)


def test_a_deadline_returns_the_best_so_far_and_reports_it():
    solution = follow(curves.circle(radius=2), seconds=20, deadline_seconds=0.0)
    assert solution.status.outcome is Outcome.BUDGET
    assert solution.motion.num_frames == 1
    assert "budget" in solution.status.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": -1.0}, "speed must be positive, got -1 m/s"),
        ({"speed": math.nan}, "speed must be positive, got nan m/s"),
        ({"seconds": math.nan}, "seconds must be positive, got nan"),
        ({"seconds": 1e9}, "frames are more than the 3600000 allowed"),
        ({"speed": 1e-7}, "frames are more than the 3600000 allowed"),
        ({"speed": SpeedProfile((0.0, 1.0), (1e-9, 1e-9))}, "more than the 3600000 allowed"),
    ],
)
def test_wishes_that_make_no_sense_are_refused(options, message):
    with pytest.raises(RequestError, match=message):
        follow(curves.circle(radius=2), **options)


def test_a_speed_beyond_the_data_is_named_with_both_numbers():
    solution = follow(curves.line(length=9), seconds=0.4, speed=9.0)
    fastest = DENSITY.limits.fastest
    assert f"9.00 m/s is faster than the prior's data, which reach {fastest:.2f} m/s" in solution.status.text
    assert solution.status.outcome is Outcome.INFEASIBLE
    assert not solution.status.ok


def notes(curve, speed, seconds, profile=None):
    request = PathRequest(curve, profile or SpeedProfile.constant(speed), seconds)
    return check_path(curve, request.arcs(request.frames(30), 30), ABLE)


def test_a_corner_is_named_with_its_place_and_angles():
    bend = curves.from_points(torch.tensor([[0.0, 0], [0, 2], [2, 2]]).double())
    (note,) = notes(bend, 1.0, 4.0)
    assert "the curve turns 90 degrees within a second at 1." in note
    assert "the prior's data turn at most 86" in note
    assert notes(curves.circle(radius=0.5), 1.2, 3.0)[0].startswith("the curve turns 13")


def test_a_curve_too_short_for_the_seconds_is_slowed_down_or_named():
    request, note = PathRequest(curves.line(length=3), SpeedProfile.constant(1.0), 4.0).fitted(30)
    assert float(request.arcs(120, 30)[-1]) == pytest.approx(3.0, abs=0.05)
    assert "the curve is 3.0 m long" in note
    assert "76 %" in note
    far, _ = PathRequest(curves.line(length=1), SpeedProfile.constant(1.0), 4.0).fitted(30)
    assert far.profile.speeds == (0.6,)
    assert "go straight on beyond the end of the curve of 1.0 m" in notes(curves.line(length=1), 1.0, 4.0)[-1]
    closed = PathRequest(curves.circle(radius=0.1), SpeedProfile.constant(1.0), 4.0)
    assert closed.fitted(30) == (closed, None)


def test_arcs_are_the_integral_of_speed():
    profile = SpeedProfile((0.0, 10.0), (1.0, 2.0))  # ds/dt = 1 + s / 10
    arcs = PathRequest(curves.line(length=20), profile, 5.0).arcs(151, 30)
    assert float(arcs[-1]) == pytest.approx(10 * (math.exp(0.5) - 1), rel=2e-3)
    frames = PathRequest(curves.line(length=5), profile).frames(30)
    assert float(PathRequest(curves.line(length=5), profile).arcs(frames, 30)[-1]) == pytest.approx(5.0, abs=0.06)
