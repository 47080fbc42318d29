"""What an armature does over the frames of the scene, as a motion of mapctl's; and back to the armature's space."""

from collections.abc import Generator
from fractions import Fraction

import bpy
import numpy as np

from ..exchange import WorldMotion
from ..problem import Step
from ..rotations import orthonormalise, transpose
from .body import Body, measure_world


def measure_fps(scene: bpy.types.Scene) -> Fraction:
    """Measure the scene's frame rate: 24 / 1.001 is 24000/1001."""
    return Fraction(scene.render.fps) / Fraction(scene.render.fps_base).limit_denominator(100_000)


def take_rest(body: Body, fps: Fraction) -> WorldMotion:
    """Take two frames of the rest pose, with the armature at the origin."""
    rest = body.to_world(body.heads)
    rotations = np.tile(np.eye(3), (2, len(body.names), 1, 1))
    return WorldMotion(body.names, body.parents, rest, fps, rotations, np.stack([rest, rest]))


def sample_motion(
    armature: bpy.types.Object, body: Body, scene: bpy.types.Scene, frames: range
) -> Generator[Step, None, tuple[WorldMotion, np.ndarray]]:
    """Sample the joints in every frame, as Blender evaluates them with all constraints; also return how the armature
    lies in the world then, (frames, 4, 4). The scene's frame is another one afterwards."""
    poses, worlds = np.empty((len(frames), len(body.bones), 4, 4)), np.empty((len(frames), 4, 4))
    for number, frame in enumerate(frames):
        scene.frame_set(frame)
        worlds[number] = measure_world(armature, scene)
        poses[number] = read_poses(armature, body.bones)
        yield Step("reading the action", number + 1, len(frames))
    moved = poses @ np.linalg.inv(body.rests)
    basis = orthonormalise(worlds[:, None, :3, :3])
    rotations = basis @ orthonormalise(moved[..., :3, :3]) @ transpose(orthonormalise(body.frame[:3, :3]))
    places = np.einsum("fjab,jb->fja", worlds[:, None] @ moved, add_one(body.heads))[..., :3]
    return WorldMotion(
        body.names, body.parents, body.to_world(body.heads), measure_fps(scene), rotations, places
    ), worlds


def sample_worlds(
    armature: bpy.types.Object, scene: bpy.types.Scene, frames: range
) -> Generator[Step, None, np.ndarray]:
    """Sample how the armature lies in the world in every frame, (frames, 4, 4): once where nothing can move it."""
    if armature.parent is None and not armature.constraints:
        return np.tile(measure_world(armature, scene), (len(frames), 1, 1))
    worlds = np.empty((len(frames), 4, 4))
    for number, frame in enumerate(frames):
        scene.frame_set(frame)
        worlds[number] = measure_world(armature, scene)
        yield Step("reading the armature's place", number + 1, len(frames))
    return worlds


def read_poses(armature: bpy.types.Object, bones: tuple[str, ...]) -> np.ndarray:
    """Read the matrices of bones in the armature's space as they are evaluated now, (bones, 4, 4)."""
    pose = armature.pose.bones
    return np.array([pose[name].matrix for name in bones], dtype=np.float64)


def to_armature(motion: WorldMotion, body: Body, worlds: np.ndarray) -> np.ndarray:
    """Convert a motion of the body to what moves each joint from its rest in the armature's space, (frames, joints, 4,
    4): rotations and places, no scale."""
    order = [motion.names.index(name) for name in body.names]
    rotations, rest = motion.rotations[:, order], body.to_world(body.heads)
    moved = np.zeros((len(rotations), len(order), 4, 4))
    moved[..., :3, :3] = rotations
    moved[..., :3, 3] = motion.positions[:, order] - (rotations @ rest[..., None])[..., 0]
    moved[..., 3, 3] = 1.0
    return np.linalg.inv(worlds)[:, None] @ moved @ body.frame


def add_one(places: np.ndarray) -> np.ndarray:
    """Append the 1 of homogeneous coordinates."""
    return np.concatenate([places, np.ones((*places.shape[:-1], 1))], axis=-1)
