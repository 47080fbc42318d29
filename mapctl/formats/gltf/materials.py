"""Colours of a glTF mesh at its vertices: base colour of the material, its picture, and the vertices' own."""

from dataclasses import dataclass, replace

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.gltf.accessors import read_accessor, read_view
from mapctl.formats.gltf.container import GltfFile, read_neighbour
from mapctl.formats.gltf.schema import Metallic, Primitive, TextureInfo
from mapctl.isolated.pictures import decode_picture, decode_srgb, encode_srgb, sample_picture

Array = np.ndarray
_WEBP = "EXT_texture_webp"


@dataclass(frozen=True, eq=False)
class Paint:
    """What gives a primitive its colours."""

    linear: Array
    """(n, 4) factor at each vertex in proportion to light, and opacity."""
    places: Array | None
    """(n, 2) where in the picture vertices are, 0 to 1 across and down; None without a picture."""
    picture: Array | None
    """(height, width, 4) sRGB, 0 to 255."""
    blended: bool
    """Whether one sees through what is not opaque."""

    def colours(self, corners: Array, shares: Array) -> Array:
        """Return the colours (n, 4), sRGB and opacity, 0 to 1, of points on triangles: see `refinement.Paint`."""
        linear = np.einsum("nc,nck->nk", shares, self.linear[corners])
        light = linear[:, :3]
        if self.places is not None and self.picture is not None:
            texels = sample_picture(self.picture, np.einsum("nc,nck->nk", shares, self.places[corners]))
            light, linear[:, 3] = light * decode_srgb(texels[:, :3]), linear[:, 3] * texels[:, 3]
        rgba = np.column_stack([encode_srgb(light), linear[:, 3]])
        if not self.blended:
            rgba[:, 3] = 1.0
        return rgba.clip(0.0, 1.0)

    def at_vertices(self) -> Array:
        """Return the colours of the vertices, (n, 4)."""
        corners = np.repeat(np.arange(len(self.linear))[:, None], 3, axis=1)
        return self.colours(corners, np.tile([1.0, 0.0, 0.0], (len(corners), 1)))

    def coarsen(self, vertices: Array, faces: Array, cell: float) -> "Paint":
        """Average what of the picture lies within cells of this length, metres, on the triangles, so that points
        between which there is more show no noise."""
        if self.picture is None or self.places is None:
            return self
        size = np.array(self.picture.shape[1::-1])
        corners, inside = vertices[faces], size * self.places[faces]
        lengths, texels = (np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2).sum() for at in (corners, inside))
        factor = int(min(cell * texels / max(lengths, 1e-9), *(size / 4)))
        return self if factor < 2 else replace(self, picture=_shrink(self.picture, factor))


def read_paint(gltf: GltfFile, primitive: Primitive, count: int, what: str) -> Paint:
    """Read what gives a primitive of `count` vertices its colours.

    Without the package pillow, or of a kind that it does not know, a picture's place is taken by the material's plain
    colour.
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
    shown = None if look.baseColorTexture is None else _read_shown(gltf, primitive, look.baseColorTexture, count)
    places, picture = (None, None) if shown is None else shown
    return Paint(linear, places, picture, blended)


def _read_shown(gltf: GltfFile, primitive: Primitive, info: TextureInfo, count: int) -> tuple[Array, Array] | None:
    """Return where the vertices are in the picture, and the picture; None where it cannot be read."""
    name = f"TEXCOORD_{info.texCoord}"
    if name not in primitive.attributes:
        return None
    picture = _read_picture(gltf, info.index)
    if picture is None:
        return None
    where = read_accessor(gltf, primitive.attributes[name], "VEC2").astype(np.float64)
    if len(where) != count:
        raise FileFormatError(gltf.path, f"{name} has {len(where)} rows for {count} vertices")
    return where, picture


def _shrink(picture: Array, factor: int) -> Array:
    """Average squares of so many texels; what is left over at the edges counts as the last square's."""
    height, width = (side // factor for side in picture.shape[:2])
    squares = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 4)
    return squares.mean(axis=(1, 3))


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
    return None if data is None else decode_picture(data)
