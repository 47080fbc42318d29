"""Frames and gaps as they are typed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapctl.commands.shared.options import parse_frame, parse_range, parse_ranges
from mapctl.errors import RequestError

frame = st.integers(0, 999_999_999)


@given(frame, st.sampled_from(["", " ", "  "]))
def test_a_whole_number_is_that_frame_at_any_rate(number, blank):
    assert parse_frame(f"{blank}{number}{blank}", fps=30.0) == number
    assert parse_frame(str(number), fps=120.0) == number


@given(st.integers(0, 100_000), st.sampled_from([24.0, 30.0, 59.94, 60.0, 120.0]))
def test_seconds_are_the_nearest_frame(milliseconds, fps):
    found = parse_frame(f"{milliseconds / 1000:.3f}s", fps=fps)
    assert abs(found - milliseconds / 1000 * fps) <= 0.5 + 1e-6


@pytest.mark.parametrize(
    "text",
    [
        "",
        "-1",
        "+3",
        "1.5",
        "s",
        ".s",
        "1e3",
        "1 s",
        "1ms",
        "nan",
        "inf",
        "nans",
        "1,5s",
        "0x10",
        "1_000",
        "9" * 5000,
        "12s3",
        "1\n2",
    ],
)
def test_anything_else_is_refused_as_it_came(text):
    with pytest.raises(RequestError, match="a frame is a whole number from 0, or seconds"):
        parse_frame(text, fps=30.0)


@given(st.lists(st.integers(0, 500), min_size=2, max_size=2, unique=True))
def test_a_range_comes_back_within_the_motion(ends):
    start, stop = sorted(ends)
    assert parse_range(f"{start}:{stop}", fps=30.0, frames=500) == (start, stop)
    with pytest.raises(RequestError, match="must begin before it ends"):
        parse_range(f"{stop}:{start}", fps=30.0, frames=500)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("12", "a gap is A:B"),
        ("", "a gap is A:B"),
        ("5-9", "a gap is A:B"),
        ("5:", "a whole number"),
        (":9", "a whole number"),
        ("5:9:12", "a whole number"),
        ("5:5", "begin before it ends"),
        ("5:101", "within the motion's frames 0:100"),
        ("100:101", "0:100"),
        ("1s:4s", "0:100"),
    ],
)
def test_what_is_no_range_of_the_motion_is_refused(text, said):
    with pytest.raises(RequestError, match=said):
        parse_range(text, fps=30.0, frames=100)


def test_frames_and_seconds_may_be_mixed():
    assert parse_range("15:1s", fps=30.0, frames=100) == (15, 30)


@given(
    st.lists(st.integers(0, 500), min_size=2, max_size=12, unique=True).filter(lambda ends: len(ends) % 2 == 0),
    st.randoms(),
)
def test_several_come_in_the_order_of_time(ends, random):
    ordered = sorted(ends)
    ranges = list(zip(ordered[::2], ordered[1::2], strict=True))
    texts = [f"{start}:{stop}" for start, stop in ranges]
    random.shuffle(texts)
    assert parse_ranges(texts, fps=30.0, frames=500) == ranges


def test_gaps_may_touch_but_not_overlap():
    assert parse_ranges(["5:10", "10:20"], fps=30.0, frames=30) == [(5, 10), (10, 20)]
    for texts in (["5:11", "10:20"], ["5:20", "8:10"], ["5:10", "5:10"]):
        with pytest.raises(RequestError, match="overlap; make them one"):
            parse_ranges(texts, fps=30.0, frames=30)
