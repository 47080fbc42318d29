"""Text files of FBX as binary ones, for readers that must know both."""

import re
import struct
import zlib

import numpy as np

_TOKEN = re.compile(r'"[^"]*"|[{}]|[\w|]+:|\*\d+|-?[\d.]+(?:[eE][-+]?\d+)?')
_ARRAYS = {"KeyTime": "l", "KeyValueFloat": "f", "KeyAttrDataFloat": "f"}
_WHOLE = ("PolygonVertexIndex", "Indexes", "KeyAttrFlags", "KeyAttrRefCount")
_DTYPES = {"l": "<i8", "f": "<f4", "i": "<i4", "d": "<f8"}


def to_binary(text: str, version: int = 7400) -> bytes:
    """A text file of `fbx_maker`, binary: 32-bit offsets before 7.5, 64-bit ones from then on."""
    tokens = _TOKEN.findall("\n".join(line for line in text.splitlines() if not line.startswith(";")))
    text_version = f"FBXVersion: {version}"
    assert text_version in text, "the version is that of the text"
    head = b"Kaydara FBX Binary  \x00\x1a\x00" + struct.pack("<I", version)
    body, at = [], 0
    while at < len(tokens):
        node, at = _read_node(tokens, at, len(head) + sum(map(len, body)), version >= 7500)
        body.append(node)
    return head + b"".join(body) + _null(version >= 7500)


def _null(wide: bool) -> bytes:
    return bytes(25 if wide else 13)


def _read_node(tokens: list[str], at: int, offset: int, wide: bool) -> tuple[bytes, int]:
    """The record of the node whose name is the token `at`, which lies at `offset` of the file; and where it ends."""
    name, at = tokens[at][:-1], at + 1
    values: list[bytes] = []
    while at < len(tokens) and not tokens[at].endswith(":") and tokens[at] not in "{}":
        if tokens[at].startswith("*"):
            stop = tokens.index("}", at)
            values.append(_array(name, tokens[at + 3 : stop]))
            at = stop + 1
        else:
            values.append(_value(tokens[at], first=not values, whole=name in ("Deformer", "Model", "C")))
            at += 1
    told, size = b"".join(values), (25 if wide else 13) + len(name)
    below: list[bytes] = []
    if at < len(tokens) and tokens[at] == "{":
        at += 1
        while tokens[at] != "}":
            node, at = _read_node(tokens, at, offset + size + len(told) + sum(map(len, below)), wide)
            below.append(node)
        below.append(_null(wide))
        at += 1
    end = offset + size + len(told) + sum(map(len, below))
    record = struct.pack("<QQQB" if wide else "<IIIB", end, len(values), len(told), len(name))
    return record + name.encode() + told + b"".join(below), at


def _value(token: str, *, first: bool, whole: bool) -> bytes:
    if token.startswith('"'):
        kind, mark, name = token[1:-1].partition("::")
        raw = f"{name}\x00\x01{kind}".encode() if mark else kind.encode()
        return b"S" + struct.pack("<I", len(raw)) + raw
    if re.fullmatch(r"-?\d+", token):
        return b"L" + struct.pack("<q", int(token)) if first or whole or abs(int(token)) > 2**31 else _number(token)
    return _number(token)


def _number(token: str) -> bytes:
    whole = re.fullmatch(r"-?\d+", token)
    return b"I" + struct.pack("<i", int(token)) if whole else b"D" + struct.pack("<d", float(token))


def _array(name: str, tokens: list[str]) -> bytes:
    kind = _ARRAYS.get(name, "i" if name in _WHOLE else "d")
    numbers = [int(token) for token in tokens] if kind in "il" else [float(token) for token in tokens]
    raw = np.array(numbers, _DTYPES[kind]).tobytes()
    packed = zlib.compress(raw)
    return kind.encode() + struct.pack("<III", len(numbers), 1, len(packed)) + packed
