"""What files with a body hold: the rest pose, and the mannequin's triangles in it; for glTF and USD alike."""

from dataclasses import dataclass

import numpy as np

from mapctl.mesh.primitives import Array
from mapctl.mesh.skinning import build_skin
from mapctl.motion import Motion


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """A body in its skeleton's rest pose: no joint is turned and the root is at the origin. Every vertex is moved
    by one joint alone.
    """

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
    joint: Array
    """(n,) index of the joint that moves a vertex."""


def build_skinned_body(motion: Motion) -> SkinnedBody:
    """Build the mannequin of a motion."""
    body, rest = build_skin(motion), _rest_positions(motion)
    linear = np.where(body.rgb <= 0.04045, body.rgb / 12.92, ((body.rgb + 0.055) / 1.055) ** 2.4)
    return SkinnedBody(rest, body.vertices + rest[body.joint], body.normals, body.faces, linear, body.joint)


def _rest_positions(motion: Motion) -> Array:
    """Return joint positions (joints, 3), metres, with all rotations zero and the root at the origin."""
    offsets, rest = motion.skeleton.offsets.numpy(), np.zeros((motion.num_joints, 3))
    for joint, parent in enumerate(motion.skeleton.parents):
        rest[joint] = offsets[joint] + rest[parent] if parent >= 0 else 0.0
    return rest
