"""One character on the stage: its mover, what is shown of it, and its recording."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.features import PRIOR_FPS
from mapctl.mesh import colours
from mapctl.runtime.live_protocol import FrameChunk, LiveCharacter
from scenes.drawn_character import DrawnCharacter
from scenes.live import ground
from scenes.live.bodies.body import BodyPose, LiveBody
from scenes.live.bodies.mannequin import LiveMannequin
from scenes.live.bodies.skinned import LiveCharacterBody
from scenes.live.inputs import SteeringInputs
from scenes.live.realtime import RealtimeMonitor
from scenes.live.recording import Recording


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
    ):
        """Set up character `number`, from 0, with its nodes below the node `world`; it is `drawn` with a mesh of its
        own, on whose bones it moves, or as a mannequin."""
        self.name = f"character {number + 1}"
        self.character, self.orders, self.first = character, orders, orders
        self.pace = RealtimeMonitor()
        self.recording: Recording | None = None
        self.gone = ""  # why it is no more
        self.place = np.zeros(2)
        self.drawn = drawn
        self._body = _add_body(scene, f"{world}/character{number + 1}", number, character, drawn)
        self._marks = ground.GroundMarks(scene, f"{world}/marks{number + 1}", character.skeleton)
        self._waiting: deque[tuple[float, FrameChunk, int, BodyPose]] = deque()

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
        self.orders, self.gone = self.first, ""
        self.pace.forget()
        self.command(obstacles)
        self.character.reset()

    def take(self, delivered: FrameChunk, now: float) -> None:
        """Keep what came until it is due, record it."""
        if self.recording is not None:
            self.recording.add(delivered)
        self.pace.add(now, delivered)
        poses = self._body.prepare(delivered.motion(self.character.skeleton))
        self._waiting.extend((delivered.due + k / PRIOR_FPS, delivered, k, pose) for k, pose in enumerate(poses))
        self._marks.forecast(delivered.forecast)

    def show_due(self, now: float) -> None:
        """Pose it as it is at this moment, a value of time.perf_counter."""
        due = None
        while self._waiting and self._waiting[0][0] <= now:
            due = self._waiting.popleft()
        if due is not None:
            self._pose(*due[1:])

    def _pose(self, delivered: FrameChunk, frame: int, pose: BodyPose) -> None:
        self._body.pose(pose)
        self.place = delivered.root[frame, ::2]
        joints = delivered.motion(self.character.skeleton).joint_positions()[frame].numpy()
        self._marks.planted(joints, delivered.contacts[frame])


def _add_body(
    scene: viser.SceneApi, name: str, number: int, character: LiveCharacter, drawn: DrawnCharacter | None
) -> LiveBody:
    if drawn is None:
        return LiveMannequin(scene, name, character.skeleton, colours.default_colour(number))
    return LiveCharacterBody(scene, name, drawn)
