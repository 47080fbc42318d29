"""One character of the live viewer: its process, its body and marks, its past, and its recording."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.runtime.live_protocol import FrameChunk, LiveCharacter
from scenes.drawn_character import DrawnCharacter
from scenes.live.bodies import BodyPose, MannequinBody, SkinnedBody
from scenes.live.camera import facing_of
from scenes.live.ground import FootMarks, Trajectories
from scenes.live.inputs import SteeringInputs

KEPT_SECONDS = 120.0
"""Seconds of shown frames that are kept for looking back."""
_TRAIL_FRAMES, _SPEED_FRAMES = 4 * PRIOR_FPS, 16  # of the past trajectory, and over which speed is measured
_PACE_SECONDS = 3.0  # over which lateness is judged
_LATE_SHARE = 0.5  # of these frames, from which the machine is too slow


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
