"""One character of the live viewer: its process, its body and marks, its past."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
import viser
from trimesh.visual import ColorVisuals

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.mesh import colours
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.mannequin import Skin, at_rest, build_skin
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.runtime.live_protocol import FrameChunk, LiveCharacter
from mapctl.skeleton import Skeleton
from scenes.drawn_character import DrawnCharacter
from scenes.live.camera import facing_of
from scenes.live.ground import FootMarks, Trajectories
from scenes.live.inputs import SteeringInputs

KEPT_SECONDS = 120.0
"""Seconds of shown frames that are kept for looking back."""
_TRAIL_FRAMES, _SPEED_FRAMES = 4 * PRIOR_FPS, 16  # of the past trajectory, and over which speed is measured
_PACE_SECONDS = 3.0  # over which lateness is judged
_LATE_SHARE = 0.5  # of these frames, from which the machine is too slow
_MAX_COLOURS = 12  # of a character's mesh
_DIGITS = 6  # decimal places of metres and weights at which vertices are the same
_NEAR = 0.03  # of a colour, 0 to 1, within which triangles are alike
_OPAQUE = 0.999


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A pose, in the terms of the body that prepared it."""

    positions: Array
    """(n, 3) positions of what the body moves, metres."""
    quat_xyzw: Array
    """(n or more, 4) rotations."""


class MannequinBody:
    """The mannequin of a skeleton below a node of a scene: meshes that hang on joints."""

    def __init__(self, scene: viser.SceneApi, name: str, skeleton: Skeleton, colour: str):
        """Add the mannequin with a torso of this `colour`."""
        body, paths = build_skin(at_rest(skeleton), colour), []
        self._joints: list[viser.FrameHandle] = []
        for joint, parent in enumerate(skeleton.parents):
            paths.append(f"{paths[parent] if parent >= 0 else name}/{skeleton.names[joint]}")
            offset = skeleton.offsets[joint].numpy()
            self._joints.append(scene.add_frame(paths[joint], show_axes=False, position=offset))
            if (part := _extract_part(body, joint)) is not None:
                scene.add_mesh_trimesh(f"{paths[joint]}/skin", part)

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of frames: position of the root, and local rotation of every joint."""
        roots, quats = motion.root_position.numpy(), motion.local_quat_xyzw.numpy()
        return [BodyPose(root[None], turns) for root, turns in zip(roots, quats, strict=True)]

    def pose(self, pose: BodyPose) -> None:
        """Move the root and turn the joints."""
        self._joints[0].position = pose.positions[0]
        for handle, wxyz in zip(self._joints, np.roll(pose.quat_xyzw, 1, axis=1), strict=True):
            handle.wxyz = wxyz


class SkinnedBody:
    """A character's own mesh below a node of a scene: sent with its weights, then only its bones are moved.

    The browser's skinned meshes have one colour, so there is one for every group of similar colours.
    """

    def __init__(self, scene: viser.SceneApi, name: str, character: DrawnCharacter):
        """Add the character's mesh in its rest pose."""
        self._character, mesh = character, character.mesh
        carriers = find_carriers(character.body.leveled_map)
        self._joints = np.unique(carriers)
        weights = _sum_weights(mesh, np.searchsorted(self._joints, carriers), len(self._joints))
        same = _find_same(np.column_stack([mesh.vertices, weights]))
        self._bones: list[tuple[int, viser.MeshSkinnedBoneHandle]] = []
        for number, (faces, rgba) in enumerate(_group_by_colour(mesh, _MAX_COLOURS)):
            self._add_group(scene, f"{name}/skin{number}", same[faces], rgba, weights)

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of frames on canonical joints with the character's bones: transforms of its bones."""
        placed = self._character.put_on(motion).placed.motion
        positions, quats = placed.joint_positions().numpy(), placed.joint_rotations().numpy()
        return [BodyPose(*pair) for pair in zip(positions[:, self._joints], quats[:, self._joints], strict=True)]

    def pose(self, pose: BodyPose) -> None:
        """Move the bones."""
        wxyz = np.roll(pose.quat_xyzw, 1, axis=1)
        for joint, bone in self._bones:
            bone.position = pose.positions[joint]
            bone.wxyz = wxyz[joint]

    def _add_group(self, scene: viser.SceneApi, name: str, faces: Array, rgba: Array, weights: Array) -> None:
        mesh = self._character.mesh
        vertices, faces = np.unique(faces, return_inverse=True)
        bones = np.flatnonzero(weights[vertices].max(axis=0) > 0)
        handle = scene.add_mesh_skinned(
            name,
            mesh.vertices[vertices],
            faces.reshape(-1, 3),
            bone_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(bones), 1)),
            bone_positions=mesh.rest[self._joints[bones]],
            skin_weights=weights[np.ix_(vertices, bones)],
            color=tuple((255 * rgba[:3]).round().astype(int).tolist()),
            opacity=None if rgba[3] > _OPAQUE else float(rgba[3]),
            side="double",
        )
        self._bones += zip(bones.tolist(), handle.bones, strict=True)


def _group_by_colour(mesh: CharacterMesh, most: int) -> list[tuple[Array, Array]]:
    """Group the triangles by colour into at most so many groups, opaque ones apart from others: their vertex indices
    (m, 3), and the mean by area of their sRGB colour and opacity (4,), 0 to 1.

    The group with the largest variance, by area, is halved at its mean along that channel (median cut, Heckbert 1982),
    until all are alike or there are enough.
    """
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rgba, area = mesh.rgba[mesh.faces].mean(axis=1), np.linalg.norm(across, axis=1) / 2 + 1e-12
    opaque = rgba[:, 3] >= _OPAQUE
    groups = [np.flatnonzero(mask) for mask in (opaque, ~opaque) if mask.any()]
    while len(groups) < most:
        spreads = [_measure_spread(rgba[group], area[group]) for group in groups]
        worst = max(range(len(groups)), key=lambda k: spreads[k].max())
        channel = int(spreads[worst].argmax())
        values = rgba[groups[worst], channel]
        if np.ptp(values) < _NEAR:
            break
        low = values <= np.average(values, weights=area[groups[worst]])
        groups[worst : worst + 1] = [groups[worst][low], groups[worst][~low]]
    return [(mesh.faces[group], np.average(rgba[group], axis=0, weights=area[group])) for group in groups]


def find_carriers(rigmap: RigMap) -> Array:
    """Return by joint of a rig the joint with which it moves as one: itself if it is a canonical one, or rests in
    another pose than the file's; else that of its parent, as fingers move with their hand."""
    parents, moving = rigmap.rig_skeleton.parents, set(rigmap.joints.values())
    still = rigmap.idle_quat_xyzw[:, 3].abs() > 1 - 1e-9
    moving |= {joint for joint in range(len(parents)) if not still[joint]}
    found: list[int] = []
    for joint, parent in enumerate(parents):
        found.append(joint if joint in moving or parent < 0 else found[parent])
    return np.array(found)


def _extract_part(body: Skin, joint: int) -> trimesh.Trimesh | None:
    """Extract the triangles that hang on a joint, None if there are none."""
    faces = body.faces[body.joint[body.faces[:, 0]] == joint]
    if not len(faces):
        return None
    used, packed = np.unique(faces, return_inverse=True)
    rgba = np.column_stack([body.rgb[used], np.ones(len(used))])
    mesh = trimesh.Trimesh(body.vertices[used], packed.reshape(-1, 3), vertex_normals=body.normals[used], process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=(255 * rgba).round().astype(np.uint8))
    return mesh


def _measure_spread(rgba: Array, area: Array) -> Array:
    """Return by channel the variance times the area."""
    spread = (area[:, None] * (rgba - np.average(rgba, axis=0, weights=area)) ** 2).sum(axis=0)
    return np.where(np.ptp(rgba, axis=0) < _NEAR, 0.0, spread)


def _find_same(rows: Array) -> Array:
    """Return for each row the first of those that are the same: a browser shades smoothly over shared vertices only,
    and files have several where texture charts meet."""
    _, first, number = np.unique(rows.round(_DIGITS), axis=0, return_index=True, return_inverse=True)
    return first[number.reshape(-1)]


def _sum_weights(mesh: CharacterMesh, bone: Array, count: int) -> Array:
    """Return the weights of bones (n, bones), by joint the `bone` that carries it."""
    summed = np.zeros((len(mesh.vertices), count))
    rows = np.arange(len(mesh.vertices))
    for joints, weights in zip(mesh.joints.T, mesh.weights.T, strict=True):
        np.add.at(summed, (rows, bone[joints]), weights)
    return summed


@dataclass(frozen=True, eq=False)
class DueFrame:
    """One frame, prepared to be shown."""

    due: float
    """Value of time.perf_counter at which it is to be seen."""
    chunk: FrameChunk
    """The chunk that it came with, without its forecast."""
    frame: int
    """Its index there."""
    pose: BodyPose
    """Pose of the body."""
    plan: Array
    """(ahead, 2) planned trajectory of the root, x and z, metres."""


@dataclass(frozen=True)
class CharacterLook:
    """How a character is shown and recorded."""

    drawn: DrawnCharacter | None = None
    """Mesh of its own; a mannequin without one."""
    on_rig: Callable[[Motion], Motion] | None = None
    """Puts its motion on the joints on which it is recorded, if these are others than those of the drawn character."""
    licence: str = ""
    """Licence of its recordings."""


class ShownCharacter:
    """A LiveCharacter with its inputs and all that the browser shows of it."""

    def __init__(self, scene: viser.SceneApi, world: str, number: int, character: LiveCharacter, look: CharacterLook):
        """Set up character `number`, from 0, with its nodes below the node `world`."""
        self.name, self.character, self.look = f"character {number + 1}", character, look
        self.inputs = SteeringInputs()
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
        self._pace: deque[tuple[float, int, int]] = deque()  # time, frames and late frames of chunks
        path, colour = f"{world}/character{number + 1}", colours.default_colour(number)
        self._body = (
            MannequinBody(scene, path, character.skeleton, colour)
            if look.drawn is None
            else SkinnedBody(scene, path, look.drawn)
        )
        self._feet = FootMarks(scene, f"{world}/feet{number + 1}", character.skeleton)
        self.trajectories = Trajectories(scene, f"{world}/trajectories{number + 1}")
        self._waiting: deque[DueFrame] = deque()
        self._shown: DueFrame | None = None

    def command(self, obstacles: Sequence[Obstacle] = ()) -> None:
        """Send the character its inputs; it leaves its path."""
        self.character.command(replace(self.inputs.command, obstacles=tuple(obstacles)))

    def aim(self, obstacles: Sequence[Obstacle] = ()) -> None:
        """Send the character its targets and obstacles alone; it keeps its path."""
        self.character.aim(replace(self.inputs.command, obstacles=tuple(obstacles)))

    def go(
        self, position: tuple[float, float], within: float, facing: float | None, obstacles: Sequence[Obstacle] = ()
    ) -> None:
        """Send the character to a position, x and z in metres, in so many seconds, facing so, radians; there it obeys
        its inputs."""
        self.character.go(replace(self.inputs.command, obstacles=tuple(obstacles)), position, within, facing)

    def reset(self, obstacles: Sequence[Obstacle] = ()) -> None:
        """Restart with the first inputs; a recording goes on."""
        self._waiting.clear()
        self._pace.clear()
        self.inputs, self.ended, self._shown = SteeringInputs(), "", None
        self.frames = self.late_frames = 0
        self.command(obstacles)
        self.character.reset()

    def pause(self, paused: bool, seconds: float = 0.0) -> None:
        """Stop the character, or let it go on after so many seconds."""
        self._pace.clear()
        self._waiting = deque(replace(one, due=one.due + seconds) for one in self._waiting)
        self.character.pause(paused)

    def receive(self, now: float) -> list[FrameChunk]:
        """Take the chunks that came until now, a value of time.perf_counter, and return them; MapctlError, once, if the
        process has ended."""
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
            self._pace.append((now, len(chunk.root), chunk.late_frames))
            self.frames += len(chunk.root)
            self.late_frames += chunk.late_frames
            poses, plan = self._body.prepare(chunk.motion(self.character.skeleton)), chunk.forecast[:, 0, ::2].copy()
            kept = replace(chunk, forecast=chunk.forecast[:0])  # two minutes of it would be large
            self._waiting += [DueFrame(chunk.due_of(k), kept, k, pose, plan) for k, pose in enumerate(poses)]
        while self._pace and now - self._pace[0][0] > _PACE_SECONDS:
            self._pace.popleft()
        return chunks

    def describe_status(self) -> str:
        """Describe speed, cost and lateness; why it has ended, and whether this machine is too slow for it."""
        if self.ended:
            return f"⚠️ {self.name.capitalize()} has ended: {self.ended}. Reset restarts it."
        if len(self.past) < 2:
            return "..."
        recent = np.array([one.chunk.root[one.frame, ::2] for one in self.past[-_SPEED_FRAMES:]])
        speed = float(np.linalg.norm(recent[-1] - recent[0])) * PRIOR_FPS / (len(recent) - 1)
        chunk = self.past[-1].chunk
        cost = 1000 * chunk.compute_seconds / len(chunk.root)
        frames, late = sum(row[1] for row in self._pace), sum(row[2] for row in self._pace)
        is_slow = frames > PRIOR_FPS / 2 and late >= _LATE_SHARE * frames
        warning = f"  \n⚠️ This machine is too slow: {100 * late / frames:.0f} % of frames come late" if is_slow else ""
        return (
            f"**{speed:.2f} m/s**, target {np.hypot(*chunk.target_velocity):.2f}  \n"
            f"{cost:.1f} ms a frame · {self.late_frames} of {self.frames} frames late{warning}"
        )

    def show_due(self, now: float) -> None:
        """Show the newest frame that is due, a value of time.perf_counter."""
        due = None
        while self._waiting and self._waiting[0].due <= now:
            due = self._waiting.popleft()
            self.past.append(due)
        if due is not None:
            del self.past[: -round(KEPT_SECONDS * PRIOR_FPS)]
            self.show_past(0)

    def show_past(self, back: int) -> None:
        """Show the frame that is so many frames before the newest one; the oldest if there are fewer."""
        if not self.past:
            return
        index = max(0, len(self.past) - 1 - back)
        shown = self.past[index]
        if shown is self._shown:
            return
        is_same_chunk = back == 0 and self._shown is not None and shown.chunk is self._shown.chunk
        chunk, k, self._shown = shown.chunk, shown.frame, shown
        self._body.pose(shown.pose)
        self.position, self.facing = chunk.root[k, ::2], facing_of(chunk.quats[k, 0])
        joints = chunk.motion(self.character.skeleton).joint_positions()[k].numpy()
        self._feet.show(joints, chunk.contacts[k])
        if not is_same_chunk:  # the bands change ten times a second
            trail = self.past[max(0, index - _TRAIL_FRAMES) : index + 1]
            positions = np.array([one.chunk.root[one.frame, ::2] for one in trail])
            jumps = np.flatnonzero(np.linalg.norm(np.diff(positions, axis=0), axis=1) > 0.5)  # by a reset
            first = int(jumps[-1]) + 1 if len(jumps) else 0
            self.trajectories.update(chunk.target_velocity, positions[first:], shown.plan)
