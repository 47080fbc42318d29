"""Colours of a glTF mesh at its vertices: base colour of the material, its picture, and the vertices' own."""

import io

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.gltf.accessors import read_accessor, read_view
from mapctl.formats.gltf.container import GltfFile, read_neighbour
from mapctl.formats.gltf.schema import Metallic, Primitive, TextureInfo

Array = np.ndarray
_MAX_PIXELS = 2**26
_WEBP = "EXT_texture_webp"


def vertex_colours(gltf: GltfFile, primitive: Primitive, count: int, what: str) -> Array:
    """Return the colours of a primitive's vertices, (n, 4) sRGB and opacity, 0 to 1.

    A picture is read where a vertex lies in it; without the package pillow, or of a kind that it does not know, its
    place is taken by the material's plain colour.
    """
    document = gltf.document
    look, blended = Metallic(), False
    if primitive.material is not None and primitive.material < len(document.materials):
        material = document.materials[primitive.material]
        look, blended = material.pbrMetallicRoughness, material.alphaMode == "BLEND"
    linear = np.tile(np.array(look.baseColorFactor), (count, 1))
    if "COLOR_0" in primitive.attributes:
        own = read_accessor(gltf, primitive.attributes["COLOR_0"], "VEC3", "VEC4").astype(np.float64)
        if len(own) != count:
            raise FileFormatError(gltf.path, f"{what} has {count} vertices and {len(own)} colours")
        linear[:, : own.shape[1]] *= own
    rgba = np.column_stack([encode_srgb(linear[:, :3]), linear[:, 3]])
    texels = None if look.baseColorTexture is None else _read_texels(gltf, primitive, look.baseColorTexture, count)
    if texels is not None:
        rgba = np.column_stack([encode_srgb(linear[:, :3] * decode_srgb(texels[:, :3])), linear[:, 3] * texels[:, 3]])
    if not blended:
        rgba[:, 3] = 1.0
    return rgba.clip(0.0, 1.0)


def encode_srgb(linear: Array) -> Array:
    """Return sRGB of colours that are in proportion to light, 0 to 1."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: Array) -> Array:
    """Undo `encode_srgb`."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _read_texels(gltf: GltfFile, primitive: Primitive, info: TextureInfo, count: int) -> Array | None:
    """Return the picture's colours at the vertices, (n, 4) sRGB, 0 to 1; None where it cannot be read."""
    name = f"TEXCOORD_{info.texCoord}"
    if name not in primitive.attributes:
        return None
    picture = _read_picture(gltf, info.index)
    if picture is None:
        return None
    where = read_accessor(gltf, primitive.attributes[name], "VEC2").astype(np.float64)
    if len(where) != count:
        raise FileFormatError(gltf.path, f"{name} has {len(where)} rows for {count} vertices")
    height, width = picture.shape[:2]
    column = np.floor(np.mod(where[:, 0], 1.0) * width).astype(int).clip(0, width - 1)
    row = np.floor(np.mod(where[:, 1], 1.0) * height).astype(int).clip(0, height - 1)
    return picture[row, column] / 255.0


def _read_picture(gltf: GltfFile, texture: int) -> Array | None:
    document = gltf.document
    if texture >= len(document.textures):
        raise FileFormatError(gltf.path, f"has no texture {texture}, but {len(document.textures)}")
    source = document.textures[texture].source
    if source is None or source >= len(document.images):
        return None
    image = document.images[source]
    data = read_neighbour(gltf.path, image.uri) if image.uri is not None else None
    if data is None and image.bufferView is not None:
        data = bytes(read_view(gltf, image.bufferView))
    return None if data is None else _decode_picture(data)


def _decode_picture(data: bytes) -> Array | None:
    try:
        from PIL import Image
    except ImportError:  # the extra `render` is not installed, and nothing will be drawn
        return None
    try:
        with Image.open(io.BytesIO(data)) as opened:
            if opened.width * opened.height > _MAX_PIXELS:
                return None
            return np.asarray(opened.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
