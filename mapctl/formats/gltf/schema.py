"""The parts of a glTF 2.0 document that a character needs, checked as they are read; all else is passed over."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

Index = Annotated[int, Field(ge=0, strict=True)]
Size = Annotated[int, Field(ge=0, le=2**40, strict=True)]
Number = Annotated[float, Field(ge=-1e30, le=1e30, allow_inf_nan=False, strict=True)]
Vector = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]
Matrix = Annotated[list[Number], Field(min_length=16, max_length=16)]


LICENCE = "licence"
"""Key of the asset's extras under which mapctl writes the licence of a motion."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", protected_namespaces=())


class Asset(_Part):
    """Version of the format."""

    version: str
    extras: object = None

    @property
    def licence(self) -> str:
        """What the file says of the licence of its motion; empty where it says nothing."""
        told = self.extras.get(LICENCE) if isinstance(self.extras, dict) else None
        return told if isinstance(told, str) else ""


class Buffer(_Part):
    """Bytes in the file's own binary chunk, in the document, or in a file beside it."""

    byteLength: Size
    uri: str | None = None


class BufferView(_Part):
    """A range of a buffer."""

    buffer: Index
    byteLength: Size
    byteOffset: Size = 0
    byteStride: Annotated[int, Field(ge=4, le=252, strict=True)] | None = None
    extensions: dict[str, object] = {}


class SparseIndices(_Part):
    """Which elements of an accessor are replaced."""

    bufferView: Index
    componentType: Literal[5121, 5123, 5125]
    byteOffset: Size = 0


class SparseValues(_Part):
    """What they are replaced by."""

    bufferView: Index
    byteOffset: Size = 0


class Sparse(_Part):
    """Elements of an accessor that are replaced."""

    count: Size
    indices: SparseIndices
    values: SparseValues


class Accessor(_Part):
    """A typed array in a view of a buffer."""

    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Annotated[int, Field(ge=1, le=2**31, strict=True)]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Index | None = None
    byteOffset: Size = 0
    normalized: bool = False
    sparse: Sparse | None = None


class Node(_Part):
    """A frame of the scene graph."""

    name: str = ""
    children: list[Index] = []
    translation: Vector = (0.0, 0.0, 0.0)
    rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    scale: Vector = (1.0, 1.0, 1.0)
    matrix: Matrix | None = None
    mesh: Index | None = None
    skin: Index | None = None


class Skin(_Part):
    """Joints that carry meshes."""

    joints: Annotated[list[Index], Field(min_length=1)]
    inverseBindMatrices: Index | None = None
    name: str = ""


class Target(_Part):
    """What an animation's channel moves."""

    path: str
    node: Index | None = None


class Channel(_Part):
    """One animated property."""

    sampler: Index
    target: Target


class Sampler(_Part):
    """Keys of a property."""

    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(_Part):
    """Properties animated together."""

    channels: list[Channel] = []
    samplers: list[Sampler] = []
    name: str = ""


class Primitive(_Part):
    """Triangles of one material."""

    attributes: dict[str, Index] = {}
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6, strict=True)] = 4
    extensions: dict[str, object] = {}


class Mesh(_Part):
    """Primitives of one node."""

    primitives: list[Primitive] = []
    name: str = ""


class TextureInfo(_Part):
    """Which texture a material shows, by which coordinates."""

    index: Index
    texCoord: Index = 0


class Metallic(_Part):
    """Base colour of a material."""

    baseColorFactor: Quaternion = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: TextureInfo | None = None


class Material(_Part):
    """Look of triangles."""

    pbrMetallicRoughness: Metallic = Metallic()
    alphaMode: str = "OPAQUE"


class Texture(_Part):
    """A picture with its sampler."""

    source: Index | None = None
    extensions: dict[str, object] = {}


class Image(_Part):
    """A picture in a buffer or a file."""

    uri: str | None = None
    bufferView: Index | None = None
    mimeType: str = ""


class Document(_Part):
    """A whole document."""

    asset: Asset
    buffers: list[Buffer] = []
    bufferViews: list[BufferView] = []
    accessors: list[Accessor] = []
    nodes: list[Node] = []
    skins: list[Skin] = []
    animations: list[Animation] = []
    meshes: list[Mesh] = []
    materials: list[Material] = []
    textures: list[Texture] = []
    images: list[Image] = []
    extensionsRequired: list[str] = []
    extensions: dict[str, object] = {}


def describe_fault(error: ValidationError) -> str:
    """Describe the first fault that pydantic found in one line: where, and what was expected."""
    first = error.errors(include_url=False)[0]
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    return f"{place or 'the document'}: {first['msg'][0].lower()}{first['msg'][1:]}"
