"""Seeded ways to break a file: bytes as editors and transfers do, values and structure as mischief does."""

import io
import json
import re
import struct
import tomllib
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from forged_characters import join_glb, split_glb

Random = np.random.Generator
Mutation = Callable[[bytes, Random], bytes]

_DEEP = 20_000
_TEXTS = {  # of these strings in a tree, quotes included, what is written in its place
    "@lists": b"[" * _DEEP + b"]" * _DEEP,
    "@tables": b'{"a":' * _DEEP + b"1" + b"}" * _DEEP,
    "@dots": b".".join([b"a"] * _DEEP),
    "@huge": b"1e999",
    "@nan": b"nan",
    "@inf": b"Infinity",
    "@digits": b"9" * 5000,
    "@hex": b"0x" + b"f" * 5000,
    "@date": b"1979-05-27",
    "@zero": b"-0",
}
ODD = (
    *_TEXTS,
    *(None, True, False, -1, 0, 1, 2, 7, 10**6, 2**31, 2**63, 1e300, -0.0, 0.5),
    *("", "x" * 3000, "nan", "a\0b", "\ud800", [], {}, [0], [[]], {"a": {"b": [1]}}, [1.0, 2.0, 3.0]),
    *("../x.bin", "/etc/passwd", "%2e%2e/b", "http://host/x.bin", "data:application/octet-stream;base64,####", "MAT4"),
)
"""What a value of a tree is replaced by."""
_NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-400", b"1e999", b"", b"0", b"-0", b"-1", b"1", b"3", b"1e8"),
    *(b"99999999", b"999999999", b"2147483648", b"9223372036854775808", b"1" + b"0" * 400, b"9" * 5000, b"0x10"),
    *(b"1_000", b"1,5", b"1.2.3", b"1-2", b"--1", b"+", b".", b"\xd9\xa2", b"1e", b"True", b"1d3", b"0.5", b"NaN(1)"),
)
_WORDS = (
    *(b"", b"{", b"}", b"End Site", b"MOTION", b"HIERARCHY", b"JOINT", b"ROOT", b"CHANNELS", b"OFFSET", b"begin"),
    *(b"end", b":root", b":DEGREES", b":x", b"#", b"(", b",", b";", b"\t", b'"', b"'", b"\xff", b"\xe2\x80\xa8"),
    *(b"\x0b", b"\x0c", b"\x85", b"\xc2\x85", b"\x1c", b"\xf0\x9f\x95\xba", b"x" * 3000, b"a b", b"rx", b"tx", b"l"),
    *(b"XYZ", b"root", b"[" * 3000, b"(" * 3000, b"<g>" * 3000, b'"""', b"\0"),
)
_ENDS = (b"\r\n", b"\r", b"\n\n", b"\n\r", b" ", b"\t\n", b"\x0b", b"\xe2\x80\xa8")
_MARKS = (b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff", b"\xef\xbb\xbf\xef\xbb\xbf")
_HEADERS = (
    *(b"(" * 400, b"'", b'"""', b"{'descr': '<f8'", b"{}", b"[1, 2]", b"1" * 5000, b"\xff\xfe", b"-" * 9000 + b"1"),
    *(
        f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}".encode()
        for descr in ("'<f8'", "'|O'", "'<U999999999'", "'<M8[ns]'", "'|V8'", "[('a', '<f8')]", "'<c16'", "'?'", "5")
        for order in ("False", "True", "3")
        for shape in ("()", "(3,)", "(10**12,)", "(1000000000000,)", "(-1,)", "(2, 0)", "(True,)", "3", "(2**31, 9)")
    ),
)
"""Dictionaries of .npy files: hostile, of other kinds, larger than the file."""


def mutate(raw: bytes, container: str, random: Random) -> bytes:
    """Break a file of a container of `CONTAINERS`, more often its values than its bytes; `text` is bytes alone."""
    forge = CONTAINERS.get(container)
    for _ in range(int(random.choice([1, 1, 1, 2, 3]))):
        change = mutate_bytes
        if forge is not None and random.random() < 0.65:
            change = forge
        try:
            raw = change(raw, random) or b" "
        except Exception:
            break  # the last change left no container
    return raw


def mutate_bytes(raw: bytes, random: Random) -> bytes:
    """Apply one mutation of bytes, lines, numbers or words."""
    return _pick(_BYTES, random)(raw, random)


def mutate_tree(tree: Any, random: Random) -> None:
    """Replace, remove, repeat or rename a value of tables and lists, at any depth with like odds."""
    holder = tree
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            return
        key = _pick(keys, random)
        below = holder[key]
        if not isinstance(below, dict | list) or not below or random.random() < 0.15:
            break
        holder = below
    kind = random.random()
    if kind < 0.1:
        del holder[key]
    elif kind < 0.2 and isinstance(holder, list):
        holder.append(holder[key])
    elif kind < 0.2:
        holder[_pick(("@dots", "", "x" * 3000, "a b", key.upper()), random)] = holder.pop(key)
    elif kind < 0.35 and isinstance(holder[key], int) and not isinstance(holder[key], bool):
        holder[key] += int(random.integers(-3, 4))
    elif kind < 0.4:
        holder[key] = _pick(([below], {"a": below}, str(below)[:50]), random)
    else:
        holder[key] = _pick(ODD, random)


def dump_toml(tree: Any) -> bytes:
    """Write a tree as TOML of one line a key."""
    return "\n".join(f"{json.dumps(key)} = {_inline(value)}" for key, value in tree.items()).encode("utf-8", "replace")


def _inline(value: Any) -> str:
    match value:
        case dict():
            return "{" + ", ".join(f"{json.dumps(key)} = {_inline(each)}" for key, each in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(_inline, value)) + "]"
        case None:
            return "none"
        case _:
            return json.dumps(value, ensure_ascii=False, default=str)


def _fill(text: bytes) -> bytes:
    for name, by in _TEXTS.items():
        text = text.replace(f'"{name}"'.encode(), by)
    return text


# --- containers -------------------------------------------------------------------------------------------------------


def _forge_json(raw: bytes, random: Random) -> bytes:
    tree = json.loads(raw)
    mutate_tree(tree, random)
    return _fill(json.dumps(tree).encode())


def _forge_toml(raw: bytes, random: Random) -> bytes:
    if _TEXTS["@dots"] in raw:  # takes the parser seconds
        return raw
    tree = tomllib.loads(raw.decode())
    mutate_tree(tree, random)
    return _fill(dump_toml(tree))


def _forge_glb(raw: bytes, random: Random) -> bytes:
    """Break the document, or numbers of the binary chunk."""
    tree, binary = split_glb(raw)
    if random.random() < 0.2 and len(binary) >= 4:
        return join_glb(json.dumps(tree).encode(), _with_odd_floats(binary, "<f4", random))
    mutate_tree(tree, random)
    return join_glb(_fill(json.dumps(tree).encode()), binary)


def _forge_safetensors(raw: bytes, random: Random) -> bytes:
    """Break the header, its length, or the numbers."""
    (size,) = struct.unpack_from("<Q", raw)
    head, data = raw[8 : 8 + size], raw[8 + size :]
    kind = random.random()
    if kind < 0.2:
        return raw[: 8 + size] + _with_odd_floats(data, "<f2", random)
    if kind < 0.3:
        return struct.pack("<Q", int(_pick((0, 1, size + 8, 2**31, 2**63, 100_000_001), random))) + head + data
    tree = json.loads(head)
    mutate_tree(tree, random)
    head = _fill(json.dumps(tree).encode())
    return struct.pack("<Q", len(head)) + head + data


def _forge_npz(raw: bytes, random: Random) -> bytes:
    """Break an array, its header, or the sizes that the archive declares."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, kind = _pick(sorted(members), random), random.random()
    if kind < 0.5:
        members[name] = _forge_array(members[name], random)
    elif kind < 0.8:
        version = _pick((b"\1\0", b"\2\0", b"\3\0", b"\7\0"), random)
        head = _pick(_HEADERS, random) + b"\n"
        size = struct.pack("<H" if version == b"\1\0" else "<I", min(len(head), 65535))
        members[name] = b"\x93NUMPY" + version + size + head + members[name][128:]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for each, content in members.items():
            archive.writestr(zipfile.ZipInfo(each), content)
    packed = bytearray(buffer.getvalue())
    if kind >= 0.8:  # in the directory of the archive: method, sizes, number of extra bytes
        entries = [found.start() for found in re.finditer(rb"PK\x01\x02", packed)]
        field, at = _pick((("<H", 8), ("<H", 10), ("<I", 20), ("<I", 24), ("<H", 28), ("<H", 30), ("<I", 42)), random)
        struct.pack_into(field, packed, _pick(entries, random) + at, int(_pick((0, 1, 8, 14, 2**16 - 1), random)))
        if field == "<I" and random.random() < 0.7:
            struct.pack_into("<I", packed, _pick(entries, random) + at, int(_pick((2**30, 2**32 - 1), random)))
    return bytes(packed)


def _forge_array(raw: bytes, random: Random) -> bytes:
    old = np.load(io.BytesIO(raw), allow_pickle=False)
    odd = float(_pick((np.nan, np.inf, 1e308, -1e308, 0.0, 1e9, -1.0, 2.0**63), random))
    changes: tuple[Callable[[], np.ndarray], ...] = (
        lambda: old[..., None],
        lambda: old.reshape(-1),
        lambda: old[:0],
        lambda: np.concatenate([old, old]),
        lambda: old.astype(_pick((np.complex128, np.float16, ">f8", np.uint8, "S", "U"), random)),
        lambda: np.array("x" * 500),
        lambda: np.zeros((2**20, 3)),
        lambda: np.array(7),
        lambda: np.flip(old),
        *[lambda: _with(old, odd, random)] * 4,
    )
    buffer = io.BytesIO()
    with np.errstate(all="ignore"):
        np.save(buffer, _pick(changes, random)())
    return buffer.getvalue()


def _with(old: np.ndarray, value: float, random: Random) -> np.ndarray:
    """Replace one element; a name by another."""
    changed = old.copy().reshape(-1)
    at = int(random.integers(len(changed)))
    changed[at] = _pick(changed, random) if old.dtype.kind == "U" else np.array(value).astype(old.dtype)
    return changed.reshape(old.shape)


def _with_odd_floats(binary: bytes, kind: str, random: Random) -> bytes:
    floats = np.frombuffer(binary[: len(binary) // 4 * 4], kind).copy()
    at = random.integers(len(floats), size=int(random.integers(1, 9)))
    with np.errstate(all="ignore"):
        floats[at] = random.choice([np.nan, np.inf, -np.inf, 0.0, 1e38, -1.0, 1e-40], size=len(at)).astype(kind)
    return floats.tobytes() + binary[len(binary) // 4 * 4 :]


def _change_bytes(raw: bytes, random: Random) -> bytes:
    """Replace a few bytes, so that most of a binary file is still read."""
    changed = bytearray(raw)
    for _ in range(int(random.integers(1, 6))):
        changed[int(random.integers(len(raw)))] = int(_pick((0, 1, 127, 128, 255, int(random.integers(256))), random))
    return bytes(changed)


CONTAINERS: dict[str, Mutation] = {
    "json": _forge_json,
    "toml": _forge_toml,
    "glb": _forge_glb,
    "safetensors": _forge_safetensors,
    "npz": _forge_npz,
    "binary": _change_bytes,
}
"""Mutations of the values of a file, by its container."""


# --- bytes, lines and words -------------------------------------------------------------------------------------------


def _pick(among: Any, random: Random) -> Any:
    return among[int(random.integers(len(among)))]


def _piece(raw: bytes, random: Random) -> tuple[int, int]:
    start = int(random.integers(len(raw)))
    return start, min(len(raw), start + int(random.integers(1, 60)))


def _match(pattern: bytes, raw: bytes, random: Random) -> tuple[int, int]:
    """Return the span of one match; those near the beginning, which hold the counts, are drawn more often."""
    found = [match.span() for match in re.finditer(pattern, raw)] or [(0, 0)]
    return _pick(found if random.random() < 0.5 else found[:40], random)


def _on_piece(change: Callable[[bytes, Random], bytes]) -> Mutation:
    def mutation(raw: bytes, random: Random) -> bytes:
        start, stop = _piece(raw, random)
        return raw[:start] + change(raw[start:stop], random) + raw[stop:]

    return mutation


def _on_match(pattern: bytes, change: Callable[[bytes, Random], bytes]) -> Mutation:
    def mutation(raw: bytes, random: Random) -> bytes:
        start, stop = _match(pattern, raw, random)
        return raw[:start] + change(raw[start:stop], random) + raw[stop:]

    return mutation


def _on_lines(change: Callable[[list[bytes], int, Random], list[bytes]]) -> Mutation:
    def mutation(raw: bytes, random: Random) -> bytes:
        lines = raw.split(b"\n")
        return b"\n".join(change(lines, int(random.integers(len(lines))), random))

    return mutation


def _flip(raw: bytes, random: Random) -> bytes:
    changed = bytearray(raw)
    for _ in range(int(random.integers(1, 4))):
        changed[int(random.integers(len(raw)))] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _exchange(raw: bytes, random: Random) -> bytes:
    (a, b), (c, d) = sorted((_match(_WORD, raw, random), _match(_WORD, raw, random)))
    return raw if b > c else raw[:a] + raw[c:d] + raw[b:c] + raw[a:b] + raw[d:]


def _move(lines: list[bytes], at: int, random: Random) -> list[bytes]:
    rest = lines[:at] + lines[at + 1 :]
    to = int(random.integers(len(lines)))
    return [*rest[:to], lines[at], *rest[to:]]


def _shuffle(lines: list[bytes], at: int, random: Random) -> list[bytes]:
    part = lines[at : at + int(random.integers(2, 12))]
    return [*lines[:at], *(part[k] for k in random.permutation(len(part))), *lines[at + len(part) :]]


def _soup(lines: list[bytes], at: int, random: Random) -> list[bytes]:
    """Insert a line of words from around it, in any order."""
    words = b" ".join(lines[max(0, at - 20) : at + 20]).split() or [b""]
    return [*lines[:at], b" ".join(_pick(words, random) for _ in range(int(random.integers(1, 40)))), *lines[at:]]


_NUMBER, _WORD = rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?", rb"[^\s,;]+"
_NUMBER_CHANGE = _on_match(_NUMBER, lambda _, random: _pick(_NUMBERS, random))
_DIGIT_CHANGE = _on_match(rb"\d", lambda _, random: b"%d" % random.integers(10))
_WORD_CHANGE = _on_match(_WORD, lambda word, random: _pick(_WORDS, random) + (word if random.random() < 0.4 else b""))
_BYTES: tuple[Mutation, ...] = (
    _flip,
    lambda raw, random: raw[: int(random.integers(len(raw)))],
    _on_piece(lambda _, random: b""),
    _on_piece(lambda piece, random: piece + piece),
    _on_piece(lambda piece, random: random.bytes(len(piece))),
    _on_piece(lambda piece, random: b"\0" + piece),
    _on_lines(lambda lines, at, random: lines[: at + 1] + lines[at:]),
    _on_lines(lambda lines, at, random: lines[:at] + lines[at + 1 :]),
    _on_lines(
        lambda lines, at, random: (
            lines[:at] + lines[at : at + 1] * min(3000, 10**6 // (len(lines[at]) + 1)) + lines[at:]
        )
    ),
    _on_lines(_move),
    _on_lines(_shuffle),
    _on_lines(_soup),
    *[_NUMBER_CHANGE] * 3,
    *[_DIGIT_CHANGE] * 2,
    *[_WORD_CHANGE] * 2,
    _exchange,
    lambda raw, random: _pick(_MARKS, random) + raw,
    lambda raw, random: raw.replace(b"\n", _pick(_ENDS, random)),
)
"""What is drawn from; numbers and words more often."""
