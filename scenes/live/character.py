"""One character of the live viewer: its process, its body and marks, its past."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
import torch
import viser

from mapctl import kinematics, rotations
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.mesh import colours
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.mannequin import at_rest, build_skin
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import TOE_JOINTS
from scenes.drawn_character import DrawnCharacter
from scenes.live.camera import WORLD, to_rgb_bytes

if TYPE_CHECKING:
    from controllers.steering.process import CharacterProcess

KEPT_SECONDS = 120.0
"""Seconds of shown frames that are kept for looking back."""
_TRAIL_FRAMES, _SPEED_FRAMES = 4 * PRIOR_FPS, 16  # of the past trajectory, and over which speed is measured
_TRAIL_POINTS, _RESET_METRES = 24, 0.5  # of a band on the ground; a step of the past that only a reset makes
_FAR = 1e4  # metres
_MARK_HEIGHT, _FOOT_RADIUS = 0.012, 0.12  # metres over the ground, and of a planted foot's disc
_MAX_COLOURS = 12  # of a character's mesh
_FIRST_SPEED = 1.2  # m/s
_OPAQUE = 0.999

Pose = tuple[Array, Array]
"""Positions (n, 3), metres, and rotations (n or more, 4), xyzw, of what a body moves."""


class SkinnedBody:
    """A mesh below a node of a scene: sent with its weights, then only its bones are moved.

    The browser's skinned meshes have one colour, so there is one for every group of similar colours.
    """

    def __init__(self, scene: viser.SceneApi, name: str, mesh: CharacterMesh, drawn: DrawnCharacter | None = None):
        """Add a mesh in its rest pose: of the character that motions are put on, else on the joints that move."""
        self._mesh, self._drawn, joints = mesh, drawn, np.arange(len(mesh.rest))
        self._joints, bone = np.unique(
            joints if drawn is None else find_carriers(drawn.body.leveled_map), return_inverse=True
        )
        weights = np.zeros((len(mesh.vertices), len(self._joints)))
        rows = np.arange(len(weights))
        for joints, shares in zip(mesh.joints.T, mesh.weights.T, strict=True):
            np.add.at(weights, (rows, bone[joints]), shares)
        # A browser shades smoothly over shared vertices only, and there are several where colours or charts meet.
        alike = np.column_stack([mesh.vertices, weights]).round(6)
        _, first, number = np.unique(alike, axis=0, return_index=True, return_inverse=True)
        faces, rgba = first[number.reshape(-1)][mesh.faces], mesh.rgba[mesh.faces].mean(axis=1)
        self._bones: list[tuple[int, viser.MeshSkinnedBoneHandle]] = []
        for group, label in enumerate(np.unique(labels := _group_colours(rgba))):
            own = labels == label
            self._add_group(scene, f"{name}/skin{group}", faces[own], rgba[own].mean(axis=0), weights)

    def prepare(self, motion: Motion) -> list[Pose]:
        """Prepare the poses of frames on canonical joints with the body's bones: transforms of its bones."""
        placed = motion if self._drawn is None else self._drawn.put_on(motion).motion
        positions, quats = placed.joint_positions().numpy(), placed.joint_rotations().numpy()
        return list(zip(positions[:, self._joints], quats[:, self._joints], strict=True))

    def pose(self, pose: Pose) -> None:
        """Move the bones."""
        wxyz = np.roll(pose[1], 1, axis=1)
        for joint, bone in self._bones:
            bone.position, bone.wxyz = pose[0][joint], wxyz[joint]

    def _add_group(self, scene: viser.SceneApi, name: str, faces: Array, rgba: Array, weights: Array) -> None:
        mesh = self._mesh
        vertices, faces = np.unique(faces, return_inverse=True)
        bones = np.flatnonzero(weights[vertices].max(axis=0) > 0)
        frames = np.tile(np.eye(3), (len(mesh.rest), 1, 1)) if mesh.frames is None else mesh.frames
        quats = rotations.from_matrix(torch.from_numpy(frames[self._joints[bones]])).numpy()
        handle = scene.add_mesh_skinned(
            name,
            mesh.vertices[vertices],
            faces.reshape(-1, 3),
            bone_wxyzs=np.roll(quats, 1, axis=1),
            bone_positions=mesh.rest[self._joints[bones]],
            skin_weights=weights[np.ix_(vertices, bones)],
            color=tuple((255 * rgba[:3]).round().astype(int).tolist()),
            opacity=None if rgba[3] > _OPAQUE else float(rgba[3]),
            side="double",
        )
        self._bones += zip(bones.tolist(), handle.bones, strict=True)


def _group_colours(rgba: Array) -> Array:
    """Return a label by triangle: those alike in colour (k-means), opaque ones apart from others."""
    distinct, of = np.unique(rgba.round(2), axis=0, return_inverse=True)
    count = min(_MAX_COLOURS // 2, len(distinct))
    _, label = scipy.cluster.vq.kmeans2(distinct, count, minit="++", rng=0)
    return (2 * label + (distinct[:, 3] < _OPAQUE))[of.reshape(-1)]


def find_carriers(rigmap: RigMap) -> Array:
    """Return by joint of a rig the joint with which it moves as one: itself if it is a canonical one, or rests in
    another pose than the file's; else that of its parent, as fingers move with their hand."""
    moving = set(rigmap.joints.values())
    moving |= set(np.flatnonzero((rigmap.idle_quat_xyzw[:, 3].abs() <= 1 - 1e-9).numpy()).tolist())
    found: list[int] = []
    for joint, parent in enumerate(rigmap.rig_skeleton.parents):
        found.append(joint if joint in moving or parent < 0 else found[parent])
    return np.array(found)


def _find_facing(chunk: FrameChunk, frame: int) -> float:
    return float(kinematics.heading(torch.from_numpy(chunk.quats[frame, 0])))


def _interpolate(first: Pose, second: Pose, share: float) -> Pose:
    """Return the pose between two, in lines and by the shortest arcs."""
    quats = torch.from_numpy(first[1]), torch.from_numpy(second[1])
    turned = rotations.slerp(*quats, torch.full(quats[0].shape[:1], share, dtype=quats[0].dtype))
    return first[0] + share * (second[0] - first[0]), turned.numpy()


class Marks:
    """Marks of one character on the ground: a disc below each planted toe, an arrow of the target velocity, and lines
    of the past and the planned trajectory."""

    def __init__(self, scene: viser.SceneApi, name: str):
        """Add them, hidden until there is something to show."""
        self._feet = [
            scene.add_cylinder(
                f"{name}/foot{k}",
                _FOOT_RADIUS,
                _MARK_HEIGHT,
                to_rgb_bytes(colour),
                wxyz=(0.5**0.5, 0.5**0.5, 0.0, 0.0),
                cast_shadow=False,
                visible=False,
            )
            for k, colour in enumerate((colours.LEFT, colours.RIGHT))
        ]
        # A browser culls what is out of view by the points that it gets first, so those are far apart.
        far = np.linspace(-_FAR, _FAR, 2 * _TRAIL_POINTS)[:, None].repeat(3, axis=1).reshape(-1, 2, 3)
        self._target = scene.add_arrows(
            f"{name}/bands/target",
            far[[0]],
            to_rgb_bytes(colours.TARGET),
            shaft_radius=0.025,
            head_radius=0.07,
            visible=False,
        )
        self._trails = [
            scene.add_line_segments(
                f"{name}/bands/{what}", far[1:], to_rgb_bytes(colours.TRAIL), thickness=thickness, visible=False
            )
            for what, thickness in (("past", 0.02), ("plan", 0.05))
        ]

    def show_feet(self, toes: Array, contacts: Array) -> None:
        """Show a disc below each toe (of toes (2, 3)) whose contact (2,) is 1."""
        for foot, (x, _, z), contact in zip(self._feet, toes, contacts, strict=True):
            foot.visible, foot.position = bool(contact > 0.5), (x, _MARK_HEIGHT / 2, z)

    def show_bands(self, velocity: tuple[float, float], past: Array, plan: Array) -> None:
        """Show a target velocity, m/s, the past root trajectory (n, 2) up to now, and the planned one, metres."""
        here = past[-1]
        self._target.visible = True
        self._target.points = np.insert([[here, here + velocity]], 1, _MARK_HEIGHT, axis=2)
        for trail, points in zip(self._trails, (past, np.concatenate([here[None], plan])), strict=True):
            at = np.linspace(0, len(points) - 1, _TRAIL_POINTS)
            flat = np.stack([np.interp(at, np.arange(len(points)), axis) for axis in points.T], axis=-1)
            line = np.insert(flat, 1, _MARK_HEIGHT, axis=1)
            trail.points, trail.visible = np.stack([line[:-1], line[1:]], axis=1), True


@dataclass(frozen=True, eq=False)
class DueFrame:
    """One frame, prepared to be shown."""

    due: float
    """Value of time.perf_counter at which it is to be seen."""
    chunk: FrameChunk
    """The chunk that it came with, without its forecast."""
    frame: int
    """Its index there."""
    pose: Pose
    """Pose of the body."""
    plan: Array
    """(ahead, 2) planned trajectory of the root, x and z, metres."""


@dataclass(frozen=True)
class CharacterLook:
    """How characters are shown and recorded."""

    drawn: DrawnCharacter | None = None
    """Mesh of its own; a mannequin without one."""
    on_rig: Callable[[Motion], Motion] = lambda motion: motion
    """Puts its motion on the joints on which it is recorded."""
    licence: str = ""
    """Licence of its recordings."""


class ShownCharacter:
    """A live character with its command and all that the browser shows of it."""

    def __init__(self, scene: viser.SceneApi, number: int, character: "CharacterProcess", look: CharacterLook):
        """Set up character `number`, from 0, with its nodes."""
        self.name, self.character, self.look = f"Character {number + 1}", character, look
        self.wanted = Command(_FIRST_SPEED, 0.0)
        """Its command."""
        self.recorded: list[FrameChunk] | None = None
        """Frames since its recording began; None while it is not recorded."""
        self.ended = ""
        """Why its process has ended."""
        self.position = np.zeros(2)
        """Position of the hips over the ground as shown, x and z, metres."""
        self.facing = 0.0
        """Facing of the hips as shown, radians from +Z toward +X."""
        self.past: list[DueFrame] = []
        """Frames that were shown, oldest first."""
        self.frames = self.late_frames = 0
        """Frames, and late ones of them, since the last reset."""
        path, colour = f"{WORLD}/character{number + 1}", colours.default_colour(number)
        mesh = build_skin(at_rest(character.skeleton), colour) if look.drawn is None else look.drawn.mesh
        self._body = SkinnedBody(scene, path, mesh, look.drawn)
        self.marks = Marks(scene, f"{WORLD}/marks{number + 1}")
        self._waiting: deque[DueFrame] = deque()
        self._shown: DueFrame | None = None

    def command(self, command: Command) -> None:
        """Have the character obey a command; it leaves its path."""
        self.wanted = command
        self.character.command(command)

    def aim(self, command: Command) -> None:
        """Give the character the targets and obstacles of a command alone; it keeps its path."""
        self.wanted = command
        self.character.aim(command)

    def reset(self) -> None:
        """Restart with the first command; a recording goes on."""
        self._waiting.clear()
        self.ended, self._shown = "", None
        self.frames = self.late_frames = 0
        self.command(Command(_FIRST_SPEED, 0.0, obstacles=self.wanted.obstacles))
        self.character.reset()

    def pause(self, paused: bool, seconds: float = 0.0) -> None:
        """Stop the character, or let it go on after so many seconds."""
        self._waiting = deque(replace(one, due=one.due + seconds) for one in self._waiting)
        self.character.pause(paused)

    def receive(self) -> list[FrameChunk]:
        """Take the chunks that came, and return them; MapctlError, once, if the process has ended."""
        if self.ended:
            return []
        try:
            chunks = self.character.poll()
        except MapctlError as error:
            self.ended = str(error)
            raise
        for chunk in chunks:
            if self.recorded is not None:
                self.recorded.append(chunk)
            self.frames += len(chunk.root)
            self.late_frames += chunk.late_frames
            poses, plan = self._body.prepare(chunk.motion(self.character.skeleton)), chunk.forecast[:, 0, ::2].copy()
            kept = replace(chunk, forecast=chunk.forecast[:0])  # two minutes of it would be large
            self._waiting += [DueFrame(chunk.due_of(k), kept, k, pose, plan) for k, pose in enumerate(poses)]
        return chunks

    def describe_status(self) -> str:
        """Describe speed, facing, cost and lateness; why it has ended, and whether this machine is too slow for it."""
        if self.ended:
            return f"⚠️ {self.name} has ended: {self.ended}. Reset restarts it."
        if len(self.past) < 2:
            return "..."
        recent = np.array([one.chunk.root[one.frame, ::2] for one in self.past[-_SPEED_FRAMES:]])
        speed = float(np.linalg.norm(recent[-1] - recent[0])) * PRIOR_FPS / (len(recent) - 1)
        chunk = self.past[-1].chunk
        off = math.degrees(math.remainder(_find_facing(chunk, -1) - chunk.target_facing, 2 * math.pi))
        is_slow = self.frames > PRIOR_FPS / 2 and 2 * self.late_frames >= self.frames
        warning = "  \n⚠️ This machine is too slow." if is_slow else ""
        return (
            f"**{speed:.2f} m/s**, target {np.hypot(*chunk.target_velocity):.2f}; facing {abs(off):.0f}° off  \n"
            f"{1000 * chunk.compute_seconds / len(chunk.root):.1f} ms a frame · "
            f"{self.late_frames} of {self.frames} frames late{warning}"
        )

    def show_due(self, now: float) -> None:
        """Show the character at a value of time.perf_counter: between the newest frame that is due and the next one."""
        count = len(self.past)
        while self._waiting and self._waiting[0].due <= now:
            self.past.append(self._waiting.popleft())
        if len(self.past) > count:
            del self.past[: -round(KEPT_SECONDS * PRIOR_FPS)]
            self.show_past(0)
        if self.past and self._waiting:
            frames = self.past[-1], self._waiting[0]
            first, second = (one.chunk.root[one.frame] for one in frames)
            share = (now - frames[0].due) / max(frames[1].due - frames[0].due, 1e-9)
            if 0 < share < 1 and np.linalg.norm(second - first) < _RESET_METRES:
                self.position = (first + share * (second - first))[::2]
                self._body.pose(_interpolate(frames[0].pose, frames[1].pose, share))

    def show_past(self, back: int) -> None:
        """Show the frame that is so many frames before the newest one; the oldest if there are fewer."""
        index = max(0, len(self.past) - 1 - back)
        if not self.past or self.past[index] is self._shown:
            return
        before, self._shown = self._shown, self.past[index]
        chunk, k = self._shown.chunk, self._shown.frame
        self._body.pose(self._shown.pose)
        self.position, self.facing = chunk.root[k, ::2], _find_facing(chunk, k)
        joints = chunk.motion(self.character.skeleton).joint_positions()[k].numpy()
        self.marks.show_feet(joints[list(TOE_JOINTS)], chunk.contacts[k])
        if back or before is None or before.chunk is not chunk:  # the bands change ten times a second
            trail = self.past[max(0, index - _TRAIL_FRAMES) : index + 1]
            positions = np.array([one.chunk.root[one.frame, ::2] for one in trail])
            jumps = np.flatnonzero(np.linalg.norm(np.diff(positions, axis=0), axis=1) > _RESET_METRES)
            first = int(jumps[-1]) + 1 if len(jumps) else 0
            self.marks.show_bands(chunk.target_velocity, positions[first:], self._shown.plan)
