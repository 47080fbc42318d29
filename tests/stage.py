"""The live viewer without a browser: characters that note what they are sent, and the loop for a while."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from helpers import walk

from mapctl.errors import RequestError
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import CANONICAL
from scenes.live.app import LiveApp
from scenes.live.character import CharacterLook


def delivered(first: int = 0, count: int = 3, *, spare: float = 0.02) -> FrameChunk:
    """Some frames of a walk, due now."""
    motion = walk(90).slice(first, first + count)
    return FrameChunk(
        time.perf_counter(),
        first / 30,
        motion.root_position.numpy(),
        motion.local_quat_xyzw.numpy(),
        np.tile([1.0, 0.0], (count, 1)),
        motion.joint_positions().numpy(),
        (0.0, 1.2),
        0.5,
        spare,
        0.05,
        np.zeros((count, 2)),
        np.zeros((0, 3)),
    )


class Actor:
    """A CharacterProcess that notes what it is sent."""

    skeleton = CANONICAL

    def __init__(self):
        self.heard: list[tuple] = []
        self.frames = 0

    def command(self, command):
        self.heard.append(("command", command))

    def go(self, command, position, within, facing=None):
        self.heard.append(("go", command, position, within, facing))

    def aim(self, command):
        self.heard.append(("aim", command))

    def walk(self, points, speed, *, closed=False):
        if len(points) < 2:
            raise RequestError("a curve needs two points")
        self.heard.append(("walk", points, speed, *[True] * closed))

    def pause(self, paused):
        self.heard.append(("pause", paused))

    def reset(self):
        self.heard.append(("reset",))

    def poll(self):
        self.frames += 3
        return [delivered((self.frames - 3) % 75)]

    def close(self):
        self.heard.append(("close",))


@contextmanager
def live_app(actors: list[Actor], look: CharacterLook | None = None, **more) -> Iterator[LiveApp]:
    """The viewer of these characters; `more` as LiveApp takes it."""
    labels = {"gait": ["run", "walk"], "style": ["old"]}
    show = LiveApp(actors, look or CharacterLook(), port=8090, fastest=3.8, labels=labels, **more)
    try:
        yield show
    finally:
        show.close()


def run(show, ticks: int = 20) -> None:
    left = iter(range(ticks))
    show.run(lambda: next(left, None) is None)
