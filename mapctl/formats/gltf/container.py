"""Files of glTF 2.0: the document and its bytes, from .glb and .vrm (one file) or .gltf with files beside it."""

import base64
import binascii
import json
import mmap
import struct
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from pydantic import ValidationError

from mapctl.errors import FileFormatError
from mapctl.formats.gltf.schema import Document, describe_fault
from mapctl.formats.text import MAX_FILE_BYTES, check_ordinary, shorten, warn_once

_MAX_JSON_BYTES = 64 * 2**20
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_MAX_DEPTH_ERROR = "is nested too deeply"
_DRAWN = ("meshes", "materials", "textures", "images")
_COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A glTF document with its buffers; bytes stay on disk until they are asked for."""

    path: Path
    """The file."""
    tree: dict[str, Any]
    """The document as it stands in the file."""
    document: Document
    """The document, checked."""
    buffers: tuple["bytes | memoryview", ...]
    """Bytes of each buffer."""
    binary: "bytes | memoryview"
    """The .glb file's own binary chunk; empty where it has none."""


def read_file(path: str | PathLike[str]) -> GltfFile:
    """Read a glTF file. FileFormatError says what is wrong with it: also compression that is not read here, and other
    files that are not there or lie outside its folder."""
    file = Path(path)
    check_ordinary(file)
    whole = _map_file(file)
    if bytes(whole[:4]) == b"glTF":
        text, binary = _split_chunks(file, whole)
    elif file.suffix.lower() == ".gltf":
        text, binary = whole, b""
    else:
        raise FileFormatError(file, f"is no binary glTF: it begins with {bytes(whole[:4])!r}, not b'glTF'")
    tree = _parse_json(file, text)
    document = _check_document(file, tree)
    if not document.asset.version.startswith("2."):
        raise FileFormatError(file, f"is glTF {shorten(document.asset.version)}, expected 2.0")
    _refuse_compression(file, document)
    return GltfFile(file, tree, document, _open_buffers(file, document, binary), binary)


def compose_glb(tree: dict[str, Any], binary: "list[bytes | memoryview]") -> "list[bytes | memoryview]":
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
        head, comma, data = uri.partition(",")
        if not comma or not head.endswith(";base64"):
            raise FileFormatError(path, f"{shorten(uri)}: data in a document are base64")
        try:
            return base64.b64decode(data, validate=True)
        except (binascii.Error, ValueError):
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


def _map_file(file: Path) -> memoryview:
    """Map the file's bytes, so that only those that are used are brought to memory."""
    with file.open("rb") as opened:
        return memoryview(mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ))


def _split_chunks(file: Path, whole: memoryview) -> tuple[memoryview, "bytes | memoryview"]:
    """Split a .glb file into its document and its binary chunk, empty where there is none."""
    if len(whole) < _HEADER.size + _CHUNK.size:
        raise FileFormatError(file, f"is cut off after {len(whole)} bytes")
    _, version, length = _HEADER.unpack(whole[: _HEADER.size])
    if version != 2:
        raise FileFormatError(file, f"is glTF {version}, expected 2.0")
    if length > len(whole):
        raise FileFormatError(file, f"is cut off: it says {length} bytes and has {len(whole)}")
    chunks: list[tuple[bytes, memoryview]] = []
    at = _HEADER.size
    while at + _CHUNK.size <= length and len(chunks) < 64:
        size, kind = _CHUNK.unpack(whole[at : at + _CHUNK.size])
        at += _CHUNK.size
        if at + size > length:
            raise FileFormatError(file, f"is cut off: a chunk of {size} bytes goes beyond its end")
        chunks.append((kind, whole[at : at + size]))
        at += size
    if not chunks or chunks[0][0] != b"JSON":
        raise FileFormatError(file, "has no JSON chunk where one is expected, after its header")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else b""
    return chunks[0][1], binary


def _parse_json(file: Path, text: memoryview) -> dict[str, Any]:
    if len(text) > _MAX_JSON_BYTES:
        raise FileFormatError(file, f"has a document of {len(text) >> 20} MiB, allowed are {_MAX_JSON_BYTES >> 20}")

    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no number of JSON")

    try:
        plain = bytes(text).decode("utf-8-sig")
        tree = json.loads(plain, parse_constant=refuse)
        if "\\ud" in plain.lower():  # half of a surrogate pair is no text, and cannot be written again
            json.dumps(tree, ensure_ascii=False).encode()
    except RecursionError:
        raise FileFormatError(file, f"its JSON {_MAX_DEPTH_ERROR}") from None
    except ValueError as error:  # also UnicodeDecodeError and JSONDecodeError
        raise FileFormatError(file, f"its JSON cannot be read: {error}") from None
    if not isinstance(tree, dict):
        raise FileFormatError(file, "its JSON is no object")
    return tree


def _check_document(file: Path, tree: dict[str, Any]) -> Document:
    """Return the checked document: without all that is drawn where a fault is only there, with a warning."""
    try:
        return Document.model_validate(tree)
    except ValidationError as error:
        if not all(fault["loc"][:1] and fault["loc"][0] in _DRAWN for fault in error.errors()):
            raise FileFormatError(file, describe_fault(error)) from None
        warn_once(f"{file}: {describe_fault(error)}; its joints and motion are read, its mesh is not")
        return Document.model_validate({key: value for key, value in tree.items() if key not in _DRAWN})


def _refuse_compression(file: Path, document: Document) -> None:
    """Refuse geometry and animations in forms of which glTF itself knows nothing."""
    for name in document.extensionsRequired:
        if name in _COMPRESSED:
            raise FileFormatError(
                file, f"is compressed ({_COMPRESSED[name]}, {name}); export it again without compression"
            )


def _open_buffers(file: Path, document: Document, binary: "bytes | memoryview") -> "tuple[bytes | memoryview, ...]":
    found: list[bytes | memoryview] = []
    for number, buffer in enumerate(document.buffers):
        if buffer.byteLength > MAX_FILE_BYTES:
            raise FileFormatError(
                file, f"buffers[{number}] has {buffer.byteLength >> 20} MiB, allowed are {MAX_FILE_BYTES >> 20}"
            )
        own = number == 0 and buffer.uri is None
        data = binary if own else b"" if buffer.uri is None else read_neighbour(file, buffer.uri)
        if len(data) < buffer.byteLength:
            raise FileFormatError(
                file, f"buffers[{number}] should have {buffer.byteLength} bytes, there are {len(data)}"
            )
        found.append(data)
    return tuple(found)
