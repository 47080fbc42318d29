"""Work a step at a time: the same result however it is sliced."""

import pytest

from mapctl.runtime.stepwise import StepwiseWork


def count_to(number, steps):
    for step in range(number):
        steps.append(step)
        yield
    return number


@pytest.mark.parametrize("seconds", [-1.0, 0.0, 1e-4, 10.0])
def test_what_comes_of_it_depends_on_no_deadline(seconds):
    steps = []
    work = StepwiseWork(count_to(5, steps))
    work.proceed(seconds)
    assert len(steps) == 0 if seconds <= 0 else len(steps) > 0
    assert work.finish() == 5
    assert work.finish() == 5
    work.proceed(1.0)
    assert steps == list(range(5))


def test_an_error_is_raised_where_it_happens():
    def fail():
        yield
        raise ValueError("broken")

    work = StepwiseWork(fail())
    for _ in range(2):  # and not as a result of nothing afterwards
        with pytest.raises(ValueError, match="broken"):
            work.finish()
