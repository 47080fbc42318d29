"""One character on the stage: its mover, what is shown of it, and its recording."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.runtime.live_protocol import FrameChunk, LiveCharacter
from scenes.drawn_character import DrawnCharacter
from scenes.live import ground
from scenes.live.bodies.body import BodyPose, LiveBody, blend_poses
from scenes.live.bodies.mannequin import LiveMannequin
from scenes.live.bodies.skinned import LiveCharacterBody
from scenes.live.bodies.tracks import Tracks
from scenes.live.inputs import SteeringInputs
from scenes.live.realtime import RealtimeMonitor
from scenes.live.recording import Recording
from scenes.live.timeline.ring import FrameRing, PastMoment
from scenes.live.view.chase import facing_of


@dataclass(frozen=True, eq=False)
class WaitingFrame:
    """A frame that waits until it is due."""

    due: float
    """Value of time.perf_counter at which it is to be seen."""
    chunk: FrameChunk
    """What it was delivered with."""
    frame: int
    """Its number there."""
    pose: BodyPose
    """Its pose."""


class LiveActor:
    """A LiveCharacter with its body, orders, pace and recording."""

    def __init__(
        self,
        scene: viser.SceneApi,
        world: str,
        number: int,
        character: LiveCharacter,
        orders: SteeringInputs,
        drawn: DrawnCharacter | None = None,
        on_rig: Callable[[Motion], Motion] | None = None,
        *,
        licence: str = "",
    ):
        """Set up character `number`, from 0, with its nodes below the node `world`; it is `drawn` with a mesh of its
        own, or as a mannequin. `on_rig` puts its motion on the joints on which it is recorded, if these are others
        than those of the drawn character; its recordings have the `licence`."""
        self.name = f"character {number + 1}"
        self.character, self.orders, self.first = character, orders, orders
        self.pace = RealtimeMonitor()
        self.recording: Recording | None = None
        self.gone = ""  # why it is no more
        self.place = np.zeros(2)
        self.facing = 0.0
        """Way that its hips face as it is shown, radians from +Z toward +X."""
        self.is_shown = False
        """Whether it has been posed."""
        self.drawn, self._on_rig, self._licence = drawn, on_rig, licence
        self._body = _add_body(scene, f"{world}/character{number + 1}", number, character, drawn)
        self._marks = ground.GroundMarks(scene, f"{world}/marks{number + 1}", character.skeleton)
        self.tracks = Tracks(scene, f"{world}/tracks{number + 1}")
        self._waiting: deque[WaitingFrame] = deque()
        self._last: WaitingFrame | None = None
        self.ring = FrameRing(character.skeleton)
        self._rate = 1.0
        self._past: tuple[int, list[BodyPose]] = (-1, [])

    def command(self, obstacles: Sequence[Obstacle] = ()) -> None:
        """Send the character its orders; it leaves its path."""
        self.character.command(replace(self.orders.command, obstacles=tuple(obstacles)))

    def aim(self, obstacles: Sequence[Obstacle] = ()) -> None:
        """Send the character what it reaches for, looks at and walks round; it keeps its path."""
        self.character.aim(replace(self.orders.command, obstacles=tuple(obstacles)))

    def go(
        self,
        place: tuple[float, float],
        within: float,
        facing: float | None,
        obstacles: Sequence[Obstacle] = (),
        *,
        stand: bool,
    ) -> None:
        """Send the character to a place, x and z in metres, in so many seconds, facing so, radians; there it obeys its
        orders, or stands. It leaves its path."""
        if stand:
            self.orders = replace(self.orders, speed=0.0)
        self.character.go(replace(self.orders.command, obstacles=tuple(obstacles)), place, within, facing)

    def reset(self, obstacles: Sequence[Obstacle] = ()) -> None:
        """Restart with the first orders; a recording goes on."""
        self._waiting.clear()
        self.tracks.forget()
        self._last = None
        self.orders, self.gone = self.first, ""
        self.pace.forget()
        self.command(obstacles)
        self.character.reset()

    def start_recording(self, folder: Path | None = None) -> None:
        """Record from now on, into a file that grows in a folder, or without a name."""
        skeleton, told = self.character.skeleton, self._licence
        self.recording = Recording(skeleton, self.drawn, folder, on_rig=self._on_rig, licence=told)

    def take(self, delivered: FrameChunk, now: float) -> None:
        """Keep what came until it is due, record it."""
        if self.recording is not None:
            self.recording.add(delivered)
        self.pace.add(now, delivered)
        poses = self._body.prepare(delivered.motion(self.character.skeleton))
        slower = delivered.rate / self._rate  # than it was meant to be: the rate has changed since
        for k, pose in enumerate(poses):
            self._waiting.append(WaitingFrame(now + (delivered.due_of(k) - now) * slower, delivered, k, pose))

    def set_rate(self, rate: float, now: float) -> None:
        """Let time pass at another rate, seconds of the character per second; RequestError where it cannot."""
        self.character.set_rate(rate)
        slower, self._rate = self._rate / rate, rate
        self._retime(lambda due: now + (due - now) * slower)
        self.pace.set_rate(rate)

    def postpone(self, seconds: float) -> None:
        """Show what waits so much later, seconds: there was a pause."""
        self._retime(lambda due: due + seconds)

    def show_due(self, now: float, show_time: float) -> None:
        """Pose it as it is at this moment: a value of time.perf_counter, and the same as seconds of the show."""
        due = None
        while self._waiting and self._waiting[0].due <= now:
            due = self._waiting.popleft()
            self.ring.add(show_time - (now - due.due) * self._rate, due.chunk, due.frame)
        if due is not None:
            self._last = due
            self._pose(due.chunk, due.frame, due.pose)
        elif self._rate < 1 and self._last is not None and self._waiting:
            self._pose_between(self._last, self._waiting[0], now)

    def show_past(self, moment: PastMoment, before: Array, after: Array) -> None:
        """See Rewindable."""
        if self._past[0] != moment.number:
            self._past = moment.number, self._body.prepare(moment.motion)
        first, second = self._past[1]
        self._body.pose(blend_poses(first, second, moment.share))
        self.place = moment.motion.root_position[0, ::2].numpy()
        self.facing = facing_of(moment.motion.local_quat_xyzw[0, 0].numpy())
        self._marks.planted(moment.motion.joint_positions()[0].numpy(), moment.contacts)
        self.tracks.look_back(self.place, moment.wish, before, after)

    def show_present(self) -> None:
        """See Rewindable."""
        self._past = (-1, [])
        self.tracks.show_present()
        if self._last is not None:
            self._pose(self._last.chunk, self._last.frame, self._last.pose)

    def _retime(self, change: Callable[[float], float]) -> None:
        self._waiting = deque(replace(one, due=change(one.due)) for one in self._waiting)
        if self._last is not None:
            self._last = replace(self._last, due=change(self._last.due))

    def _pose_between(self, last: WaitingFrame, following: WaitingFrame, now: float) -> None:
        """Pose it between two frames, as slow motion shows."""
        span = following.due - last.due
        share = min(1.0, max(0.0, (now - last.due) / span)) if span > 0 else 0.0
        self._body.pose(blend_poses(last.pose, following.pose, share))
        ends = (one.chunk.root[one.frame, ::2] for one in (last, following))
        here, there = ends
        self.place = (1 - share) * here + share * there

    def _pose(self, delivered: FrameChunk, frame: int, pose: BodyPose) -> None:
        self._body.pose(pose)
        self.place = delivered.root[frame, ::2]
        self.facing, self.is_shown = facing_of(delivered.quats[frame, 0]), True
        joints = delivered.motion(self.character.skeleton).joint_positions()[frame].numpy()
        self._marks.planted(joints, delivered.contacts[frame])
        if self.tracks.are_behind(delivered.seconds):
            self.tracks.update(delivered.seconds, self.place, delivered.wish, delivered.forecast[:, 0, ::2])


def _add_body(
    scene: viser.SceneApi, name: str, number: int, character: LiveCharacter, drawn: DrawnCharacter | None
) -> LiveBody:
    if drawn is None:
        return LiveMannequin(scene, name, character.skeleton, colours.default_colour(number))
    return LiveCharacterBody(scene, name, drawn)
