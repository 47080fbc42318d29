"""Files of characters with faults that are still files: one value of the document is another."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ODD = (
    None,
    True,
    -1,
    0,
    1,
    2,
    7,
    10**6,
    2**31,
    2**63,
    1e300,
    0.5,
    "",
    "x" * 3000,
    [],
    {},
    [0],
    [[]],
    "nan",
    "../x.bin",
)
ODD_TEXTS = (
    "data:application/octet-stream;base64,####",
    "http://host/x.bin",
    "/etc/passwd",
    "a/../../b",
    "%2e%2e/b",
    "MAT4",
)


def split_glb(raw: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of a sound .glb."""
    size = struct.unpack_from("<I", raw, 12)[0]
    rest = raw[20 + size :]
    return json.loads(raw[20 : 20 + size]), rest[8 : 8 + struct.unpack_from("<I", rest)[0]] if rest else b""


def join_glb(tree: Any, binary: bytes) -> bytes:
    """A .glb of a document and a binary chunk."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def edit_glb(path: Path, change: Callable[[Any], object]) -> None:
    """Write the .glb with another document: CHANGE is given the old one to alter."""
    tree, binary = split_glb(path.read_bytes())
    change(tree)
    path.write_bytes(join_glb(tree, binary))


def forge_glb(raw: bytes, random: np.random.Generator) -> bytes:
    """A sound container whose document has one to three odd values, or numbers that are odd."""
    tree, binary = split_glb(raw)
    for _ in range(int(random.integers(1, 4))):
        _replace_value(tree, random)
    if random.random() < 0.2:
        floats = np.frombuffer(binary[: len(binary) // 4 * 4], "<f4").copy()
        at = random.integers(len(floats), size=int(random.integers(1, 9)))
        floats[at] = random.choice([np.nan, np.inf, -np.inf, 0.0, 1e38, -1.0, 1e-40], size=len(at))
        binary = floats.tobytes()
    return join_glb(tree, binary)


def _replace_value(tree: dict[str, Any], random: np.random.Generator) -> None:
    """Replace, remove or repeat a value, at any depth with like odds."""
    holder: Any = tree
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            return
        key = keys[int(random.integers(len(keys)))]
        below = holder[key]
        if not isinstance(below, dict | list) or not below or random.random() < 0.15:
            break
        holder = below
    kind = random.random()
    if kind < 0.15:
        del holder[key]
    elif kind < 0.25 and isinstance(holder, list):
        holder.append(holder[key])
    elif kind < 0.35 and isinstance(holder[key], int) and not isinstance(holder[key], bool):
        holder[key] += int(random.integers(-3, 4))
    elif kind < 0.45:
        holder[key] = ODD_TEXTS[int(random.integers(len(ODD_TEXTS)))]
    else:
        holder[key] = ODD[int(random.integers(len(ODD)))]


def count_nodes(path: Path) -> int:
    """Nodes in a .glb's document."""
    return len(split_glb(path.read_bytes())[0]["nodes"])
