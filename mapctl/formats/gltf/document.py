"""Files of glTF 2.0: the JSON document and its buffers, from .glb and .vrm (one file) or .gltf with files beside it.

The document is read and written as plain dictionaries: pygltflib takes seconds to read one of a thousand accessors.
"""

import base64
import functools
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, ParamSpec, TypeVar
from urllib.parse import unquote

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.text import MAX_FILE_BYTES, check_ordinary, one_line, read_bytes, shorten

Array = np.ndarray
Json = dict[str, Any]
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_VALUES = 2**28
_MALFORMED = (AttributeError, LookupError, TypeError, ValueError, OverflowError, RecursionError)

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A glTF document with its buffers."""

    path: Path
    """The file."""
    tree: Json
    """The document."""
    buffers: list[bytes]
    """Bytes of each buffer."""

    def all(self, kind: str) -> list[Json]:
        """Return all of the document's `nodes`, `skins`, `accessors`, ..."""
        return self.tree.get(kind, [])

    def get(self, kind: str, index: int) -> Json:
        """Return one of them. FileFormatError where there is none of this index."""
        found = self.all(kind)
        if not 0 <= index < len(found):
            raise FileFormatError(self.path, f"has no {kind}[{index}], but {len(found)}")
        return found[index]


def refuse_malformed(read: Callable[P, T]) -> Callable[P, T]:
    """Have FileFormatError raised where a document, whose path is the last word of another error, has other entries
    than glTF's."""

    @functools.wraps(read)
    def done(*words: P.args, **options: P.kwargs) -> T:
        try:
            return read(*words, **options)
        except _MALFORMED as error:
            path = next(word for word in words if isinstance(word, str | PathLike))
            raise FileFormatError(path, f"is no sound glTF file: {type(error).__name__}: {one_line(error)}") from error

    return done


@refuse_malformed
def read_file(path: str | PathLike[str]) -> GltfFile:
    """Read a glTF file. FileFormatError says what is wrong with it: also compression that is not read here, and other
    files that are not there or lie outside its folder."""
    file = Path(path)
    raw = read_bytes(file)
    if raw[:4] == b"glTF":
        text, binary = _split_chunks(file, raw)
    elif file.suffix.lower() == ".gltf":
        text, binary = raw, b""
    else:
        raise FileFormatError(file, f"is no binary glTF: it begins with {raw[:4]!r}, not b'glTF'")
    tree = _parse_json(file, text)
    version = str(tree["asset"]["version"])
    if not version.startswith("2."):
        raise FileFormatError(file, f"is glTF {shorten(version)}, expected 2.0")
    for name in _COMPRESSED.keys() & set(tree.get("extensionsRequired", ())):
        what = f"is compressed ({_COMPRESSED[name]}, {name}); export it again without compression"
        raise FileFormatError(file, what)
    return GltfFile(file, tree, _open_buffers(file, tree.get("buffers", []), binary))


def compose_glb(tree: Json, binary: list[bytes]) -> list[bytes]:
    """Compose the pieces of a .glb file of a document and the pieces of its binary chunk, of a multiple of 4 bytes."""
    text = json.dumps(tree, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(len(piece) for piece in binary)
    chunks = [_CHUNK.pack(len(text), b"JSON"), text]
    if size:
        chunks += [_CHUNK.pack(size, b"BIN\0"), *binary]
    return [_HEADER.pack(b"glTF", 2, _HEADER.size + sum(len(chunk) for chunk in chunks)), *chunks]


def read_neighbour(path: Path, uri: str) -> bytes:
    """Read what a document names by `uri`: data within it, or a file in its folder or below.

    FileFormatError where it is not there, lies elsewhere, or is none of both.
    """
    if uri.startswith("data:"):
        head, _, data = uri.partition(",")
        if not head.endswith(";base64"):
            raise FileFormatError(path, f"{shorten(uri)}: data in a document are base64")
        try:
            return base64.b64decode(data, validate=True)
        except ValueError:
            raise FileFormatError(path, f"{shorten(uri)}: is no base64") from None
    named = Path(unquote(uri).replace("\0", "?"))
    folder = path.parent.resolve()
    target = (folder / named).resolve()
    if "://" in uri or named.is_absolute() or not target.is_relative_to(folder):
        raise FileFormatError(path, f"names {shorten(uri)}, which is not in its folder; such files are not read")
    if not target.is_file():
        raise FileFormatError(path, f"names {shorten(uri)}, which is not there")
    check_ordinary(target)
    return target.read_bytes()


def read_view(gltf: GltfFile, index: int) -> memoryview:
    """Return the bytes of a view of a buffer; FileFormatError where it is not there or compressed."""
    view = gltf.get("bufferViews", index)
    if _COMPRESSED.keys() & view.get("extensions", {}).keys():
        raise FileFormatError(gltf.path, f"bufferViews[{index}] is compressed (meshopt); export it without compression")
    gltf.get("buffers", view["buffer"])
    data, start = gltf.buffers[view["buffer"]], view.get("byteOffset", 0)
    stop = start + view["byteLength"]
    if not 0 <= start <= stop <= len(data):
        raise FileFormatError(gltf.path, f"bufferViews[{index}] goes beyond its buffer of {len(data)} bytes")
    return memoryview(data)[start:stop]


def read_accessor(gltf: GltfFile, index: int, *kinds: str) -> Array:
    """Return an accessor's numbers, (count, width): float64, scaled where they are normalised, or whole as they are.

    `kinds` are the types allowed here, such as `VEC3`. FileFormatError where it is not there, is of another type, lies
    beyond its buffer, or holds what is not finite.
    """
    accessor, what = gltf.get("accessors", index), f"accessors[{index}]"
    count, kind, component = accessor["count"], accessor["type"], accessor["componentType"]
    if kind not in kinds:
        raise FileFormatError(gltf.path, f"{what} is {kind}, expected {' or '.join(kinds)}")
    if component not in _DTYPES or not 0 < count * _WIDTHS[kind] <= _MAX_VALUES:
        raise FileFormatError(gltf.path, f"{what} has {count} elements of componentType {component}")
    dtype, shape = np.dtype(_DTYPES[component]).newbyteorder("<"), (count, _WIDTHS[kind])
    values = np.zeros(shape, dtype)
    if accessor.get("bufferView") is not None:
        values = _read_table(gltf, accessor, shape, dtype, what)
    if accessor.get("sparse") is not None:
        values = _replace_sparse(gltf, accessor["sparse"], values, f"{what}.sparse")
    if dtype.kind == "f":
        if not np.isfinite(values).all():
            raise FileFormatError(gltf.path, f"{what} holds numbers that are not finite")
        return values.astype(np.float64)
    if accessor.get("normalized", False):
        return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0)
    return values.astype(np.int64)


def _read_table(gltf: GltfFile, entry: Json, shape: tuple[int, int], dtype: np.dtype, what: str) -> Array:
    """Read a table from the view that an entry names; rows may lie further apart than they are long."""
    index, offset = entry["bufferView"], entry.get("byteOffset", 0)
    data, row = read_view(gltf, index), shape[1] * dtype.itemsize
    stride = gltf.get("bufferViews", index).get("byteStride") or row
    needed = offset + (shape[0] - 1) * stride + row
    if offset < 0 or needed > len(data) or stride < row:
        raise FileFormatError(gltf.path, f"{what} needs {needed} bytes of bufferViews[{index}], which has {len(data)}")
    return np.ndarray(shape, dtype, data, offset, (stride, dtype.itemsize))


def _replace_sparse(gltf: GltfFile, sparse: Json, values: Array, what: str) -> Array:
    count = sparse["count"]
    if not 0 < count <= len(values):
        raise FileFormatError(gltf.path, f"{what} replaces {count} of {len(values)} elements")
    kind = np.dtype(_DTYPES[sparse["indices"]["componentType"]]).newbyteorder("<")
    at = _read_table(gltf, sparse["indices"], (count, 1), kind, what)[:, 0]
    done = values.copy()
    done[at.astype(np.int64)] = _read_table(gltf, sparse["values"], (count, values.shape[1]), values.dtype, what)
    return done


def _split_chunks(file: Path, whole: bytes) -> tuple[bytes, bytes]:
    """Split a .glb file into its document and its binary chunk, empty where there is none."""
    if len(whole) < _HEADER.size + _CHUNK.size:
        raise FileFormatError(file, f"is cut off after {len(whole)} bytes")
    _, version, length = _HEADER.unpack_from(whole)
    if version != 2:
        raise FileFormatError(file, f"is glTF {version}, expected 2.0")
    if length > len(whole):
        raise FileFormatError(file, f"is cut off: it says {length} bytes and has {len(whole)}")
    chunks: list[tuple[bytes, bytes]] = []
    at = _HEADER.size
    while at + _CHUNK.size <= length and len(chunks) < 2:
        size, kind = _CHUNK.unpack_from(whole, at)
        at += _CHUNK.size
        if at + size > length:
            raise FileFormatError(file, f"is cut off: a chunk of {size} bytes goes beyond its end")
        chunks.append((kind, whole[at : at + size]))
        at += size
    if not chunks or chunks[0][0] != b"JSON":
        raise FileFormatError(file, "has no JSON chunk where one is expected, after its header")
    return chunks[0][1], chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else b""


def _parse_json(file: Path, text: bytes) -> Json:
    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no number of JSON")

    try:
        plain = text.decode("utf-8-sig")
        tree = json.loads(plain, parse_constant=refuse)
        if "\\ud" in plain.lower():  # half of a surrogate pair is no text, and cannot be written again
            json.dumps(tree, ensure_ascii=False).encode()
    except RecursionError:
        raise FileFormatError(file, "its JSON is nested too deeply") from None
    except ValueError as error:  # also UnicodeDecodeError and JSONDecodeError
        raise FileFormatError(file, f"its JSON cannot be read: {error}") from None
    if not isinstance(tree, dict):
        raise FileFormatError(file, "its JSON is no object")
    return tree


def _open_buffers(file: Path, buffers: list[Json], binary: bytes) -> list[bytes]:
    found: list[bytes] = []
    for number, buffer in enumerate(buffers):
        size, uri = buffer["byteLength"], buffer.get("uri")
        data = read_neighbour(file, uri) if uri is not None else binary if number == 0 else b""
        if not 0 <= size <= min(len(data), MAX_FILE_BYTES):
            raise FileFormatError(file, f"buffers[{number}] should have {size} bytes, there are {len(data)}")
        found.append(data)
    return found
