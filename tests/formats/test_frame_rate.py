"""Printed frame times are read as the rates they were printed from."""

from fractions import Fraction

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from mapctl.formats.units import frame_rate

RATES = {
    "0.0333333": 30,
    "0.0333": 30,
    "3.33333e-2": 30,
    "0.03333333507180214": 30,
    "0.00833333": 120,
    "0.008333": 120,
    "0.016667": 60,
    "0.0416667": 24,
    "0.041708": Fraction(24000, 1001),
    "0.033367": Fraction(30000, 1001),
    "0.04": 25,
    "0.01": 100,
    "0.08": Fraction(25, 2),
    "0.0142857": 70,
    "0.133333": Fraction(15, 2),
    "0.033898305": Fraction(59, 2),
    "0.0345678": Fraction(10**7, 345678),
}


@pytest.mark.parametrize("text", RATES)
def test_frame_time_is_read_as_the_rate_it_was_printed_from(text):
    assert frame_rate(text) == RATES[text]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.integers(1, 999), st.integers(6, 12))
def test_every_whole_rate_survives_its_print(fps, digits):
    assert abs(frame_rate(f"{1 / fps:.{digits}f}") - fps) / fps <= 0.5 * 10.0**-digits * fps
    assert frame_rate(f"{1 / fps:.9f}") == fps
