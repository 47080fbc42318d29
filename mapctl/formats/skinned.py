"""What files with a body hold: the rest pose, and triangles in it; for glTF and USD alike."""

from dataclasses import dataclass
from importlib import import_module

import numpy as np

from mapctl.errors import MapctlError
from mapctl.formats.character import CharacterSource, ending_family
from mapctl.formats.parts import decode_srgb
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.mannequin import build_skin
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion

_FAMILIES = {".glb": "gltf", ".vrma": "gltf", ".usd": "usd", ".fbx": "fbx"}
_MOST_CARRIERS = 4  # joints of a vertex, as every engine takes them


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """A body in its skeleton's rest pose: no joint is turned and the root is at the origin."""

    name: str
    """What it is: the mannequin, or a character's own mesh."""
    rest: Array
    """(joints, 3) joints, metres."""
    vertices: Array
    """(n, 3) metres."""
    normals: Array
    """(n, 3) unit."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    linear_rgb: Array
    """(n, 3) colours, 0 to 1, in proportion to light as both formats want them."""
    joints: Array
    """(n, k) indices of the joints that move a vertex, at most four."""
    weights: Array
    """(n, k) their shares; each vertex's add up to 1."""


def build_skinned_body(motion: Motion) -> SkinnedBody:
    """Build the body of a motion: the mesh of the character that it is of, with a colour at every vertex, where that
    came from a file of another format; else the mannequin."""
    rest, mesh = _rest_positions(motion), _load_own_mesh(motion)
    if mesh is not None:
        joints, weights = _strongest(mesh)
        vertices, rgb = mesh.vertices - mesh.rest[0], mesh.rgba[:, :3]
        return SkinnedBody("character", rest, vertices, mesh.normals, mesh.faces, decode_srgb(rgb), joints, weights)
    body = build_skin(motion)
    one = np.ones((len(body.joint), 1))
    vertices = body.vertices + rest[body.joint]
    return SkinnedBody(
        "mannequin", rest, vertices, body.normals, body.faces, decode_srgb(body.rgb), body.joint[:, None], one
    )


def _load_own_mesh(motion: Motion) -> CharacterMesh | None:
    """Load the mesh of the character's file; None for other motions, and for files without triangles."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.holds(motion) or source.has_new_root:
        return None
    try:
        source.check_unchanged()
        return import_module(f"mapctl.formats.{_FAMILIES[ending_family(source.path.suffix)]}").load_mesh(source.choice)
    except MapctlError:
        return None


def _strongest(mesh: CharacterMesh) -> tuple[Array, Array]:
    """Return the strongest carriers of each vertex, and their shares, which add up to 1."""
    order = np.argsort(-mesh.weights, axis=1, kind="stable")[:, :_MOST_CARRIERS]
    joints, weights = (np.take_along_axis(table, order, axis=1) for table in (mesh.joints, mesh.weights))
    return joints, weights / weights.sum(axis=1, keepdims=True)


def _rest_positions(motion: Motion) -> Array:
    """Return joint positions (joints, 3), metres, with all rotations zero and the root at the origin."""
    offsets, rest = motion.skeleton.offsets.numpy(), np.zeros((motion.num_joints, 3))
    for joint, parent in enumerate(motion.skeleton.parents):
        rest[joint] = offsets[joint] + rest[parent] if parent >= 0 else 0.0
    return rest
