"""VRM 0 and 1, and VRM animations: which node of a file is which bone of a humanoid, as the file itself says."""

from collections.abc import Mapping
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


ANIMATION = "VRMC_vrm_animation"
"""Extension of a file that holds the animation of a humanoid alone."""
_EXTENSIONS = "VRMC_vrm", ANIMATION


def is_vrm(gltf: GltfFile) -> bool:
    """Return whether the file is a VRM character, 0 or 1, or a VRM animation, whatever its ending."""
    return any(name in gltf.document.extensions for name in ("VRM", *_EXTENSIONS))


def read_bones(gltf: GltfFile) -> dict[str, int]:
    """Return the node of each bone of the humanoid, by VRM's name; empty for files that are no VRM."""
    extensions = gltf.document.extensions
    try:
        for name in _EXTENSIONS:
            if name in extensions:
                bones = _Vrm1.model_validate(extensions[name]).humanoid.humanBones
                return {bone: found.node for bone, found in bones.items()}
        if "VRM" in extensions:
            return {bone.bone: bone.node for bone in _Vrm0.model_validate(extensions["VRM"]).humanoid.humanBones}
    except ValidationError as error:
        raise FileFormatError(gltf.path, f"its VRM humanoid: {describe_fault(error)}") from None
    return {}


def select_canonical(bones: Mapping[str, str]) -> dict[str, str]:
    """Return what is given by bone for the canonical joints alone. VRM's `upperChest`, which carries the arms, is the
    canonical chest where a file has one."""
    chest = {"chest": bones["upperChest"]} if "upperChest" in bones else {}
    return {name: own for name, own in {**bones, **chest}.items() if name in CANONICAL.names}
