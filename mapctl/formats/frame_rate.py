"""The exact frame rate behind a printed frame time: 0.0333333 means 30 fps, 0.041708 means 24000/1001."""

from decimal import Decimal
from fractions import Fraction

SHORTEST_FRAME, LONGEST_FRAME = 1e-5, 100.0
"""Least and greatest frame time, seconds."""
SLOWEST, FASTEST = 0.01, 1e5
"""Least and greatest frame rate, frames per second."""

_RATES = (30, 60, 120, 24, 25, 50, 100, 15, 20, 40, 48, 72, 75, 90, 144, 150, 200, 240)
_COMMON = tuple(Fraction(rate) for rate in _RATES)
_TELEVISION = tuple(Fraction(rate * 1000, 1001) for rate in (24, 30, 48, 60, 120, 240))
_FLOAT32 = 1.2e-7  # Some exporters print a float32 with 17 digits, of which 7 mean something.


def frame_rate(frame_time: str) -> Fraction:
    """Return frames per second of a frame time as printed (seconds, a finite positive decimal number).

    A sensible rate whose frame time, rounded or cut, prints as this text; else the reciprocal as it is.
    """
    printed = Decimal(frame_time)
    seconds, exact = float(printed), 1 / Fraction(printed)
    # One digit says too little to second-guess, and a whole rate needs no help.
    if len(printed.normalize().as_tuple().digits) < 2 or exact.denominator == 1:
        return exact
    unit = 10.0 ** int(printed.as_tuple().exponent)
    low = seconds - max(unit / 2, seconds * _FLOAT32)
    high = seconds + max(unit, seconds * _FLOAT32)  # a cut number lies up to a whole unit above its print
    near = tuple(exact.limit_denominator(largest) for largest in (1, 4))
    for rate in (*_COMMON, *_TELEVISION, *near):
        if rate > 0 and low <= 1 / rate < high:
            return rate
    return exact
