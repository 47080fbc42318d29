"""The mannequin as triangles that each hang on one joint: what a file or a viewer moves without drawing it anew."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch

from mapctl.mesh import colours
from mapctl.mesh.mannequin import Mannequin
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton


@dataclass(frozen=True, eq=False)
class Skin:
    """Triangles in the frames of the joints that carry them."""

    vertices: Array
    """(n, 3) metres, each in its joint's frame."""
    normals: Array
    """(n, 3) unit, likewise."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside; all three of one joint."""
    rgb: Array
    """(n, 3) sRGB, 0 to 1."""
    joint: Array
    """(n,) index of the joint."""


def build_skin(motion: Motion, colour: str = "slate") -> Skin:
    """Build the body of a motion; its frames show when feet are flat, so it should hold more than one step.

    `colour` is the torso's: a name of `colours.ACTORS` or `#rrggbb`; RequestError otherwise.
    """
    body = Mannequin(motion, colours.rgb(colour))
    boxes, joint_of_box = body.boxes(0), body.joints()
    surfaces = [box.surface() for box in boxes]
    counts = [len(surface.vertices) // len(box.centre) for surface, box in zip(surfaces, boxes, strict=True)]
    joint = np.concatenate([np.repeat(joints, many) for joints, many in zip(joint_of_box, counts, strict=True)])
    whole = body.surface(0)
    turn = body.anatomy.rotations[0, joint]
    place = body.anatomy.points.world[0, joint]
    assert whole.normals is not None, "boxes are lit"
    return Skin(
        vertices=np.einsum("nji,nj->ni", turn, whole.vertices - place),
        normals=np.einsum("nji,nj->ni", turn, whole.normals),
        faces=whole.faces,
        rgb=whole.rgba[:, :3],
        joint=joint,
    )


def at_rest(skeleton: Skeleton = CANONICAL) -> Motion:
    """Return one frame of a skeleton in its rest pose, the lowest joint as high as a toe joint of a flat foot."""
    still = torch.zeros(1, skeleton.num_joints, 4, dtype=torch.float64)
    still[..., 3] = 1.0
    motion = Motion(skeleton, Fraction(30), torch.zeros(1, 3, dtype=torch.float64), still)
    lowest = float(motion.joint_positions()[..., 1].min())
    return Motion(
        skeleton, Fraction(30), torch.tensor([[0.0, TOE_REST_HEIGHT - lowest, 0.0]], dtype=torch.float64), still
    )
