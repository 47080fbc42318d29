"""Ways to break a file: what editors, exporters, transfers and mischief do to text and bytes."""

import re
from collections.abc import Callable

import numpy as np

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_DIGIT = re.compile(rb"\d")
_WORD = re.compile(rb"[^\s,;]+")
NUMBERS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e308",
    b"-1e308",
    b"1e-400",
    b"1e999",
    b"",
    b"0",
    b"-0",
    b"-1",
    b"1",
    b"3",
    b"1e8",
    b"99999999",
    b"999999999",
    b"2147483648",
    b"9223372036854775808",
    b"1" + b"0" * 400,
    b"9" * 5000,
    b"0x10",
    b"1_000",
    b"1,5",
    b"1.2.3",
    b"1-2",
    b"--1",
    b"+",
    b".",
    b"\xd9\xa2",
    b"1e",
    b"True",
    b"1d3",
    b"0.5",
    b"NaN(1)",
)
"""What a number is replaced by."""
WORDS = (
    b"",
    b"{",
    b"}",
    b"End Site",
    b"MOTION",
    b"HIERARCHY",
    b"JOINT",
    b"ROOT",
    b"CHANNELS",
    b"OFFSET",
    b"begin",
    b"end",
    b":root",
    b":DEGREES",
    b":x",
    b"#",
    b"(",
    b",",
    b";",
    b"\t",
    b'"',
    b"'",
    b"\xff",
    b"\xe2\x80\xa8",
    b"\x0b",
    b"\x0c",
    b"\x85",
    b"\xc2\x85",
    b"\x1c",
    b"\xf0\x9f\x95\xba",
    b"x" * 3000,
    b"a b",
    b"rx",
    b"tx",
    b"l",
    b"XYZ",
    b"root",
)
"""What a word is replaced by, or gets before it."""

Mutation = Callable[[bytes, np.random.Generator], bytes]


def mutated(raw: bytes, random: np.random.Generator) -> bytes:
    """The file after one to three mutations, mostly one; never empty."""
    for _ in range(int(random.choice([1, 1, 1, 2, 3]))):
        raw = MUTATIONS[int(random.integers(len(MUTATIONS)))](raw, random) or b" "
    return raw


def _flip(raw: bytes, random: np.random.Generator) -> bytes:
    changed = bytearray(raw)
    for _ in range(int(random.integers(1, 4))):
        changed[int(random.integers(len(raw)))] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _cut(raw: bytes, random: np.random.Generator) -> bytes:
    return raw[: int(random.integers(len(raw)))]


def _piece(raw: bytes, random: np.random.Generator) -> tuple[int, int]:
    start = int(random.integers(len(raw)))
    return start, min(len(raw), start + int(random.integers(1, 60)))


def _drop(raw: bytes, random: np.random.Generator) -> bytes:
    start, stop = _piece(raw, random)
    return raw[:start] + raw[stop:]


def _repeat(raw: bytes, random: np.random.Generator) -> bytes:
    start, stop = _piece(raw, random)
    return raw[:stop] + raw[start:]


def _noise(raw: bytes, random: np.random.Generator) -> bytes:
    start, stop = _piece(raw, random)
    return raw[:start] + random.integers(0, 256, stop - start, dtype=np.uint8).tobytes() + raw[stop:]


def _twice(raw: bytes, random: np.random.Generator) -> bytes:
    lines = raw.split(b"\n")
    at = int(random.integers(len(lines)))
    return b"\n".join(lines[: at + 1] + lines[at:])


def _without(raw: bytes, random: np.random.Generator) -> bytes:
    lines = raw.split(b"\n")
    del lines[int(random.integers(len(lines)))]
    return b"\n".join(lines)


def _moved(raw: bytes, random: np.random.Generator) -> bytes:
    lines = raw.split(b"\n")
    taken = lines.pop(int(random.integers(len(lines))))
    lines.insert(int(random.integers(len(lines) + 1)), taken)
    return b"\n".join(lines)


def _shuffled(raw: bytes, random: np.random.Generator) -> bytes:
    lines = raw.split(b"\n")
    start = int(random.integers(len(lines)))
    stop = start + int(random.integers(2, 12))
    part = [lines[start:stop][k] for k in random.permutation(len(lines[start:stop]))]
    return b"\n".join(lines[:start] + part + lines[stop:])


def _place(pattern: re.Pattern[bytes], raw: bytes, random: np.random.Generator) -> tuple[int, int]:
    """Where one match is; matches near the beginning, which hold the counts, are taken more often."""
    found = [match.span() for match in pattern.finditer(raw)] or [(0, 0)]
    most = len(found) if random.random() < 0.5 else min(len(found), 40)
    return found[int(random.integers(most))]


def _number(raw: bytes, random: np.random.Generator) -> bytes:
    start, stop = _place(_NUMBER, raw, random)
    return raw[:start] + NUMBERS[int(random.integers(len(NUMBERS)))] + raw[stop:]


def _digit(raw: bytes, random: np.random.Generator) -> bytes:
    """What is often read, as another number."""
    start, _ = _place(_DIGIT, raw, random)
    return raw[:start] + b"%d" % random.integers(10) + raw[start + 1 :]


def _word(raw: bytes, random: np.random.Generator) -> bytes:
    start, stop = _place(_WORD, raw, random)
    kept = raw[start:stop] if random.random() < 0.4 else b""
    return raw[:start] + WORDS[int(random.integers(len(WORDS)))] + kept + raw[stop:]


def _exchanged(raw: bytes, random: np.random.Generator) -> bytes:
    (a, b), (c, d) = sorted((_place(_WORD, raw, random), _place(_WORD, raw, random)))
    return raw if b > c else raw[:a] + raw[c:d] + raw[b:c] + raw[a:b] + raw[d:]


def _many(raw: bytes, random: np.random.Generator) -> bytes:
    """One line thousands of times."""
    lines = raw.split(b"\n")
    at = int(random.integers(len(lines)))
    return b"\n".join(lines[:at] + lines[at : at + 1] * 3000 + lines[at:])


def _nul(raw: bytes, random: np.random.Generator) -> bytes:
    at = int(random.integers(len(raw)))
    return raw[:at] + b"\0" + raw[at:]


def _marked(raw: bytes, random: np.random.Generator) -> bytes:
    marks = (b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff", b"\xef\xbb\xbf\xef\xbb\xbf")
    return marks[int(random.integers(len(marks)))] + raw


def _line_ends(raw: bytes, random: np.random.Generator) -> bytes:
    ends = (b"\r\n", b"\r", b"\n\n", b"\n\r", b" ", b"\t\n", b"\x0b", b"\xe2\x80\xa8")
    return raw.replace(b"\n", ends[int(random.integers(len(ends)))])


MUTATIONS: tuple[Mutation, ...] = (
    _flip,
    _cut,
    _drop,
    _repeat,
    _noise,
    _twice,
    _without,
    _moved,
    _shuffled,
    _number,
    _number,
    _number,
    _digit,
    _digit,
    _word,
    _word,
    _exchanged,
    _many,
    _nul,
    _marked,
    _line_ends,
)
"""What is drawn from; numbers and words more often."""
