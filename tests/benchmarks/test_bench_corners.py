"""`mapctl bench shots --corners`: a row a course, measured on walks that are known."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import run, walk

from controllers.benchmarks.shots import corners
from controllers.shots.planning.way import plan_way
from mapctl import curves


def slide(request, *, aside: float, behind: float):
    """A body that glides along the way, beside it and behind where it is to be, both metres."""
    way = plan_way(request)
    motion = walk(len(way.arcs))
    arcs = way.arcs - behind
    ground = way.curve.ground_point(arcs) + aside * way.curve.left(arcs)
    root = torch.stack([ground[:, 0], motion.root_position[:, 1], ground[:, 1]], dim=-1)
    still = motion.local_quat_xyzw[:1].expand_as(motion.local_quat_xyzw)
    return SimpleNamespace(way=way, motion=replace(motion, root_position=root, local_quat_xyzw=still))


@pytest.fixture
def glides(monkeypatch):
    """Walks of the benchmark: farther aside with each seed, and the second one late."""

    def solve(_prior, _inbetweener, request, *, generator):
        seed = generator.initial_seed()
        return slide(request, aside=0.02 * (seed + 1), behind=0.3 * seed)

    monkeypatch.setattr(corners, "solve_shot", solve)
    monkeypatch.setattr(corners, "COURSES", {"round": lambda: curves.circle(radius=2.0), **corners.COURSES})


def test_a_row_tells_how_far_a_course_is_left_and_how_late(glides, capsys):
    assert run("bench", "shots", "--corners", "--seeds", "2", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    rows = {row["course"]: row for row in told["rows"]}
    assert list(rows) == list(corners.COURSES)
    first = rows["round"]
    assert first["left_cm"] == pytest.approx(3.0, abs=0.1)
    assert first["left_worst_cm"] == pytest.approx(4.0, abs=0.1)
    assert first["behind_worst_cm"] == pytest.approx(30.0, abs=0.6)
    assert first["of_a_circle_s"] == 1
    assert rows["circle of 2 m"]["of_a_circle_s"] == pytest.approx(1)
    sharp = rows["90 degrees"]
    assert sharp["toe_acceleration_m_s2"] > 2 * first["toe_acceleration_m_s2"], "a glide turns at once"
    assert sharp["of_a_circle_s"] == pytest.approx(sharp["toe_acceleration_m_s2"] / first["toe_acceleration_m_s2"])
    assert rows["90 degrees"]["slowest_m_s"] < rows["45 degrees"]["slowest_m_s"] <= 1.2 + 1e-6
    assert rows["reversal"]["slowest_m_s"] < 0.2


def test_courses_turn_by_what_their_names_say():
    for degrees in (45, 90, 135, 180):
        name = "reversal" if degrees == 180 else f"{degrees} degrees"
        course = corners.COURSES[name]()
        turned = torch.rad2deg(course.heading(course.length) - course.heading(0.0)).abs()
        assert float(turned) == pytest.approx(degrees, abs=0.1)
