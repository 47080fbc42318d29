"""When a curve of validations is flat, how the learning rate then falls, and when a run's time is up."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapctl.errors import CheckpointError, RequestError
from priors.training.ending.course import Course, UntilFlat
from priors.training.ending.decay import Decay
from priors.training.ending.flatness import LEAST_POINTS, find_greatest_gain, is_flat
from priors.training.parallel import ALONE
from priors.training.recipes.lstm_gmm import DensityRecipe
from priors.training.recipes.path import PathRecipe, PathSettings
from priors.training.trainer import Trainer, find_rise, warmup_cosine

PLANNED, EVERY = 3200, 100


def curve(error, *, noise=0.0, steps=3 * PLANNED, every=EVERY, seed=0):
    """Steps and logarithms of an error that is a function of the step, scattered."""
    scatter = noise * np.random.default_rng(seed).standard_normal(steps // every)
    return [(step, math.log(error(step)) + scatter[n]) for n, step in enumerate(range(every, steps + 1, every))]


def first_flat(points, share=0.02):
    """The step at which a curve is first called flat."""
    return next((points[n][0] for n in range(len(points)) if is_flat(points[: n + 1], share)), None)


def settling(step):
    """Three times as much, falling to its end by two in e over a sixth of the plan."""
    return 1 + 2 * math.exp(-step / (PLANNED / 6))


def test_the_gain_of_a_clean_curve_is_what_it_fell_over_its_last_third():
    points = curve(lambda step: step**-0.1, steps=3000)
    assert find_greatest_gain(points) == pytest.approx(0.1 * math.log(1.5), rel=0.1)
    assert find_greatest_gain([(step, -error) for step, error in points]) == pytest.approx(-0.04, rel=0.2)


def test_too_few_validations_say_nothing():
    assert find_greatest_gain([]) is None
    points = curve(lambda step: 1.0, steps=EVERY * (3 * LEAST_POINTS - 3))
    assert find_greatest_gain(points) is None
    assert not is_flat(points, 0.02)
    assert is_flat(curve(lambda step: 1.0, steps=EVERY * (3 * LEAST_POINTS + 1)), 0.02)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_a_curve_that_settles_is_flat_soon_after_it_has(noise):
    """At three quarters of the plan it is within two percent of its end, and a half later so is all the last third."""
    found = [first_flat(curve(settling, noise=noise, seed=seed)) for seed in range(8)]
    assert all(0.75 * PLANNED <= step <= 2 * PLANNED for step in found), found
    # What was still to be had is little.
    assert np.mean([settling(step) - 1 for step in found]) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_curve_that_goes_on_falling_is_not(noise):
    for seed in range(4):
        assert first_flat(curve(lambda step: step**-0.15, noise=noise, seed=seed)) is None


def test_two_wild_validations_do_not_end_a_run_that_still_learns():
    """The second half of the last third is outliers of a curve that falls by a tenth there."""
    points = curve(lambda step: step**-0.25, steps=PLANNED)
    for wild in ((-2,), (-1,), (-2, -4), (-1, -5)):
        spoilt = list(points)
        for place in wild:
            spoilt[place] = (points[place][0], points[place][1] + 0.5)
        assert not is_flat(spoilt, 0.02), wild


def test_a_curve_that_rises_is_flat():
    assert is_flat(curve(lambda step: 1 + step / PLANNED, steps=PLANNED), 0.02)


def test_one_flat_look_is_not_enough():
    points = curve(settling)
    found = first_flat(points)
    last = [point for point in points if point[0] <= found]
    assert find_greatest_gain(last[:-1]) < 0.02 <= find_greatest_gain(last[:-2])


def test_the_rate_falls_from_all_to_nothing_over_the_decay():
    decay = Decay(100, 25)
    assert (decay.end, str(decay)) == (125, "100:25")
    rates = [decay.compute_rate(step) for step in range(95, 130)]
    assert rates[:5] == [1.0] * 5
    assert rates[30:] == [0.0] * 5 or all(rate < 1e-9 for rate in rates[30:])
    falling = rates[4:31]
    assert all(after < before for before, after in pairwise(falling))
    assert 0 < decay.compute_rate(124) < 0.03
    assert decay.compute_rate(100 + 5) == pytest.approx(1 - math.sqrt(6 / 26))


def test_a_steady_run_rises_as_others_do():
    rises = [find_rise(step, 400) for step in range(60)]
    assert rises[:20] == [warmup_cosine(step, 400) for step in range(20)]
    assert rises[20:] == [1.0] * 40


class Still(Trainer):
    """A trainer that is told where it is."""

    def train_step(self):
        return {}

    def validate(self, corpus):
        return {}


class Clock:
    """Goes when it is told to."""

    def __init__(self):
        self.seconds = 5.0

    def __call__(self):
        return self.seconds


def go_on(course, clock, *, steps, seconds):
    """So many steps, each of so many seconds, until the end is decided."""
    for _ in range(steps):
        course.trainer.step += 1
        clock.seconds += seconds
        if course.overdue and course.decide([], overdue=True, group=ALONE):
            return


def make_course(rule=None, minutes=None, **options):
    clock = Clock()
    return Course(rule, minutes, Still(steps=100, seed=1), least=50, clock=clock, **options), clock


def test_a_run_whose_curve_never_becomes_flat_ends_at_three_times_its_plan():
    course, _ = make_course(UntilFlat())
    assert (course.trainer.steady, course.trainer.steps) == (True, 300)
    course.trainer.step = 239
    assert course.decide([], overdue=False, group=ALONE) is None
    course.trainer.step = 240
    end = course.decide([], overdue=False, group=ALONE)
    assert end.decay == Decay(240, 60)
    assert "not flat after 240 steps" in end.reason
    assert course.trainer.steps == 300
    assert course.decide([], overdue=True, group=ALONE) is None


def test_nothing_is_flat_before_what_grows_has_grown():
    course, _ = make_course(UntilFlat())
    flat = [(step, 0.0) for step in range(1, 50)]
    course.trainer.step = 49
    assert course.decide(flat, overdue=False, group=ALONE) is None
    course.trainer.step = 50
    assert course.decide(flat, overdue=False, group=ALONE) is None  # measured at 49, not here
    end = course.decide([*flat, (50, 0.0)], overdue=False, group=ALONE)
    assert end.decay == Decay(50, 12)
    assert "flat" in end.reason
    assert not end.by_clock


def test_a_decay_that_is_told_is_kept_whatever_the_curve_is_like():
    course, _ = make_course(UntilFlat(decay_from=Decay(70, 5)))
    course.trainer.step = 60
    assert course.decide([(step, 0.0) for step in range(1, 61)], overdue=False, group=ALONE) is None
    course.trainer.step = 70
    assert course.decide([], overdue=False, group=ALONE).decay == Decay(70, 5)


@pytest.mark.parametrize("cost", [1.0, 2.0])
def test_a_run_ends_within_its_minutes_with_its_decay(cost):
    course, clock = make_course(UntilFlat(), 1.0, cost=cost)
    go_on(course, clock, steps=100, seconds=1.0)
    decay = course.trainer.decay
    assert decay.steps == pytest.approx(0.25 * decay.begin, abs=1)
    assert 55 <= decay.begin + cost * decay.steps <= 61
    assert course.end.by_clock
    assert course.end.reason == "1 minutes were nearly up"


def test_minutes_that_are_over_leave_one_step():
    course, clock = make_course(UntilFlat(), 1.0)
    go_on(course, clock, steps=1, seconds=400.0)
    assert course.trainer.decay == Decay(1, 1)


def test_a_run_whose_rate_does_not_fall_ends_at_once():
    course, clock = make_course(None, 1.0)
    go_on(course, clock, steps=90, seconds=1.0)
    assert (course.trainer.step, course.trainer.steps) == (60, 60)


def test_the_time_of_all_parts_counts(tmp_path):
    course, clock = make_course(UntilFlat(), 1.0)
    course.trainer.step, clock.seconds = 30, 35.0
    index = course.as_index() | {"step": 30}
    assert index["seconds"] == 30.0
    later, after = make_course(UntilFlat(), 1.0)
    later.trainer.step = 30
    later.load(tmp_path, index)
    go_on(later, after, steps=60, seconds=1.0)
    assert later.trainer.decay.end <= 61
    assert later.as_card()["ended"]["minutes"] == pytest.approx(later.trainer.step / 60, abs=0.01)


def test_a_run_goes_on_in_the_way_in_which_it_was_begun(tmp_path):
    course, _ = make_course(UntilFlat())
    index = course.as_index() | {"step": 3}
    for other in (None, UntilFlat(share=0.01), UntilFlat(decay_from=Decay(5, 5))):
        with pytest.raises(CheckpointError, match="was begun with --until-flat"):
            make_course(other)[0].load(tmp_path, index)
    with pytest.raises(CheckpointError, match="was begun with a length of its own"):
        course.load(tmp_path, {"step": 3})
    assert make_course()[0].as_index() == make_course()[0].as_card() == {}


@pytest.mark.parametrize("wrong", [{"share": 0.0}, {"decay": -1.0}, {"most": math.nan}, {"decay_from": Decay(0, 5)}])
def test_rules_that_make_no_sense_are_refused(wrong):
    with pytest.raises(RequestError, match=r"positive|at least 1"):
        UntilFlat(**wrong)


def test_the_number_that_a_curve_is_judged_by(tmp_path):
    settings = PathSettings(steps=64)
    recipe = PathRecipe(tmp_path, tmp_path, settings=settings, until_flat=UntilFlat())
    assert (recipe.validation_steps, recipe.least_steps()) == (2, 32)
    assert PathRecipe(tmp_path, tmp_path, settings=settings).validation_steps == 1000
    rows = [{"step": 2, "all_V1_cm": 2.0, "all_Y_cm": 8.0, "walk_V1_cm": 9.0}, {"step": 4, "all_V1_cm": None}]
    assert recipe.find_points(rows) == [(2, pytest.approx(math.log(4.0)))]
    # Nats have no zero: a hundredth of a nat for each number of a frame is a percent.
    one, other = (DensityRecipe.find_log_error({"validation_nats": nats}) for nats in (-116.0, -116.66))
    assert one - other == pytest.approx(0.01, abs=0.001)


def test_a_scattered_curve_has_to_be_looked_at_longer():
    """What may have been gained is more where little can be seen, and less the more validations there are."""
    clean, scattered = (
        [find_greatest_gain(curve(lambda step: 1.0, noise=noise, seed=s)) for s in range(20)] for noise in (0.0, 0.03)
    )
    assert max(clean) == 0.0
    assert 0.003 < np.mean(scattered) < 0.02
    few = [find_greatest_gain(curve(lambda step: 1.0, noise=0.03, seed=s, every=400)) for s in range(20)]
    assert np.mean(few) > 1.3 * np.mean(scattered)
