"""Motion matching along curves, and the table that sets it beside densities."""

import pytest
import torch
from helpers import walk
from tiny_prior import save_walking_density

import priors
from controllers.benchmarks.following import FollowBenchmarkSettings, benchmark_follow
from controllers.benchmarks.following.motion_matching import MotionDatabase, follow_by_matching
from mapctl import curves
from mapctl.errors import RequestError
from mapctl.features import encode
from mapctl.metrics import measure


@pytest.fixture(scope="module")
def database() -> MotionDatabase:
    return MotionDatabase.of([encode(walk(150, seed=seed, cadence=0.8 + 0.05 * seed))[0].float() for seed in range(3)])


def matched(database, curve, seconds=4.0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return follow_by_matching(database, curve, seconds=seconds, speed=1.2, generator=generator)[0]


def test_it_begins_on_the_curve_and_goes_along_it(database):
    curve = curves.line(length=6)
    motion = matched(database, curve)
    assert motion.num_frames == 120
    assert measure(motion, curve)["path_error_max_cm"] < 30


def test_a_frame_that_is_asked_for_as_it_is_is_found(database):
    """Distances are of the same columns on both sides: a candidate's own columns have it at distance 0."""
    number = 40
    away, found = database.tree.query(database.columns[database.candidates[number]])
    assert (away, found) == (0.0, number)


def test_jumps_fade(database):
    """No joint moves farther from one frame to the next than three times as far as where capture is played."""
    motion = matched(database, curves.circle(radius=2.0), seconds=6.0)
    largest = motion.joint_positions().diff(dim=0).norm(dim=-1).amax(dim=1)
    clip = walk(150, seed=0).joint_positions().diff(dim=0).norm(dim=-1).amax()
    assert float(largest.max()) < 3 * float(clip)


def test_a_seed_gives_the_same_walk_and_another_one_another(database):
    curve = curves.circle(radius=2.0)
    first, again, other = (matched(database, curve, seed=seed).root_position for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_clips_too_short_to_look_ahead_are_refused():
    with pytest.raises(RequestError, match="more than 31 frames"):
        MotionDatabase.of([encode(walk(20))[0].float()])


@pytest.mark.slow
def test_the_table_has_a_row_for_each_curve_and_method(database, tmp_path):
    density = priors.load(str(save_walking_density(tmp_path / "tiny.safetensors")))
    settings = FollowBenchmarkSettings(courses=(("line:2", 1.2),), seeds=2)
    rows = benchmark_follow({"tiny": density}, database, settings)
    assert [row["method"] for row in rows] == ["tiny", "motion matching", "motion matching, planted"]
    as_is, planted = rows[1:]
    assert planted["contact_speed_cm_s"] < as_is["contact_speed_cm_s"]
    assert as_is["path_error_mean_cm"] <= as_is["path_error_max_cm"]
