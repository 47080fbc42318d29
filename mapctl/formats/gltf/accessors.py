"""Arrays of a glTF document: bytes of a buffer, seen as numbers."""

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.gltf.container import GltfFile
from mapctl.formats.gltf.schema import Accessor

Array = np.ndarray
_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_VALUES = 2**28
_COMPRESSION = "EXT_meshopt_compression", "KHR_meshopt_compression"


def read_accessor(gltf: GltfFile, index: int, *kinds: str) -> Array:
    """Return an accessor's numbers, (count, width): float64, scaled where they are normalised, or whole as they are.

    `kinds` are the types allowed here, such as `VEC3`. FileFormatError where it is not there, is of another type, lies
    beyond its buffer, or holds what is not finite.
    """
    if index >= len(gltf.document.accessors):
        raise FileFormatError(gltf.path, f"has no accessor {index}, but {len(gltf.document.accessors)}")
    accessor = gltf.document.accessors[index]
    if accessor.type not in kinds:
        raise FileFormatError(gltf.path, f"accessors[{index}] is {accessor.type}, expected {' or '.join(kinds)}")
    width = _WIDTHS[accessor.type]
    if accessor.count * width > _MAX_VALUES:
        raise FileFormatError(gltf.path, f"accessors[{index}] has {accessor.count} elements, which is too many")
    dtype = np.dtype(_DTYPES[accessor.componentType]).newbyteorder("<")
    values = np.zeros((accessor.count, width), dtype)
    if accessor.bufferView is not None:
        what = f"accessors[{index}]"
        values = _read_view(gltf, accessor.bufferView, accessor.byteOffset, (accessor.count, width), dtype, what)
    if accessor.sparse is not None:
        values = _replace_sparse(gltf, accessor, values, dtype, f"accessors[{index}].sparse")
    return _to_numbers(gltf, accessor, values, index)


def read_view(gltf: GltfFile, index: int) -> memoryview:
    """Return the bytes of a view of a buffer; FileFormatError where it is not there or compressed."""
    if index >= len(gltf.document.bufferViews):
        raise FileFormatError(gltf.path, f"has no bufferView {index}, but {len(gltf.document.bufferViews)}")
    view = gltf.document.bufferViews[index]
    if any(name in view.extensions for name in _COMPRESSION):
        raise FileFormatError(gltf.path, f"bufferViews[{index}] is compressed (meshopt); export it without compression")
    if view.buffer >= len(gltf.buffers):
        raise FileFormatError(gltf.path, f"has no buffer {view.buffer}, but {len(gltf.buffers)}")
    data = gltf.buffers[view.buffer]
    if view.byteOffset + view.byteLength > len(data):
        raise FileFormatError(
            gltf.path, f"bufferViews[{index}] goes beyond buffers[{view.buffer}] of {len(data)} bytes"
        )
    return memoryview(data)[view.byteOffset : view.byteOffset + view.byteLength]


def _read_view(gltf: GltfFile, index: int, offset: int, shape: tuple[int, int], dtype: np.dtype, what: str) -> Array:
    """Read a table from a view; rows may lie further apart than they are long."""
    data = read_view(gltf, index)
    row = shape[1] * dtype.itemsize
    stride = gltf.document.bufferViews[index].byteStride or row
    needed = offset + (shape[0] - 1) * stride + row
    if needed > len(data) or stride < row:
        raise FileFormatError(gltf.path, f"{what} needs {needed} bytes of bufferViews[{index}], which has {len(data)}")
    return np.ndarray(shape, dtype, data, offset, (stride, dtype.itemsize))


def _replace_sparse(gltf: GltfFile, accessor: Accessor, values: Array, dtype: np.dtype, what: str) -> Array:
    sparse = accessor.sparse
    assert sparse is not None
    if not 0 < sparse.count <= accessor.count:
        raise FileFormatError(gltf.path, f"{what} replaces {sparse.count} of {accessor.count} elements")
    kind = np.dtype(_DTYPES[sparse.indices.componentType]).newbyteorder("<")
    at = _read_view(gltf, sparse.indices.bufferView, sparse.indices.byteOffset, (sparse.count, 1), kind, what)[:, 0]
    if at.max() >= accessor.count:
        raise FileFormatError(gltf.path, f"{what} names element {at.max()} of {accessor.count}")
    done = values.copy()
    shape = (sparse.count, values.shape[1])
    done[at] = _read_view(gltf, sparse.values.bufferView, sparse.values.byteOffset, shape, dtype, what)
    return done


def _to_numbers(gltf: GltfFile, accessor: Accessor, values: Array, index: int) -> Array:
    if accessor.componentType == 5126:
        if not np.isfinite(values).all():
            raise FileFormatError(gltf.path, f"accessors[{index}] holds numbers that are not finite")
        return values.astype(np.float64)
    if accessor.normalized:
        return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0)
    return values.astype(np.int64)
