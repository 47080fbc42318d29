"""VRM 0 and 1: which node of a file is which bone of a humanoid, as the file itself says."""

from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from mapctl.errors import FileFormatError
from mapctl.formats.gltf.container import GltfFile
from mapctl.formats.gltf.schema import describe_fault
from mapctl.skeleton import CANONICAL

_Index = Annotated[int, Field(ge=0, strict=True)]


class _Bone0(BaseModel):
    bone: str
    node: _Index


class _Humanoid0(BaseModel):
    humanBones: list[_Bone0] = []


class _Vrm0(BaseModel):
    humanoid: _Humanoid0 = _Humanoid0()


class _Bone1(BaseModel):
    node: _Index


class _Humanoid1(BaseModel):
    humanBones: dict[str, _Bone1] = {}


class _Vrm1(BaseModel):
    humanoid: _Humanoid1 = _Humanoid1()


def is_vrm(gltf: GltfFile) -> bool:
    """Return whether the file is a VRM character, 0 or 1, whatever its ending."""
    return any(name in gltf.document.extensions for name in ("VRM", "VRMC_vrm"))


def read_humanoid(gltf: GltfFile) -> dict[str, int]:
    """Return the node of each canonical joint that the file names; empty for files that are no VRM.

    VRM's `upperChest`, which carries the arms, is the canonical chest where a file has one.
    """
    extensions = gltf.document.extensions
    try:
        if "VRMC_vrm" in extensions:
            bones = _Vrm1.model_validate(extensions["VRMC_vrm"]).humanoid.humanBones
            nodes = {name: bone.node for name, bone in bones.items()}
        elif "VRM" in extensions:
            nodes = {bone.bone: bone.node for bone in _Vrm0.model_validate(extensions["VRM"]).humanoid.humanBones}
        else:
            return {}
    except ValidationError as error:
        raise FileFormatError(gltf.path, f"its VRM humanoid: {describe_fault(error)}") from None
    if "upperChest" in nodes:
        nodes["chest"] = nodes["upperChest"]
    return {name: node for name, node in nodes.items() if name in CANONICAL.names}
