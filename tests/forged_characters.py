"""A .glb file as its document and its binary chunk, to be altered."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any


def split_glb(raw: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of a sound .glb."""
    size = struct.unpack_from("<I", raw, 12)[0]
    rest = raw[20 + size :]
    return json.loads(raw[20 : 20 + size]), rest[8 : 8 + struct.unpack_from("<I", rest)[0]] if rest else b""


def join_glb(tree: Any, binary: bytes) -> bytes:
    """A .glb of a document, a tree or its text, and a binary chunk."""
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
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
