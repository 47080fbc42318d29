"""A receiver of poses, as an engine is one: it notes when each frame was whole."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np

from mapctl.streaming.receiver import read_messages
from mapctl.streaming.sender import FrameAssembler, VmcFrame


def free_ports(count: int) -> int:
    """The first of so many ports that follow each other and are free."""
    for base in range(43000, 60000, 50):
        result = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
        try:
            for k, one in enumerate(result):
                one.bind(("127.0.0.1", base + k))
            return base
        except OSError:
            continue
        finally:
            for one in result:
                one.close()
    raise AssertionError("no free ports")


class Engine:
    """Listener at a port, on a thread."""

    def __init__(self, port: int):
        self.frames: list[VmcFrame] = []
        self.times: list[float] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.1)
        self._ends = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        assembler = FrameAssembler()
        with closing(self._socket):
            while not self._ends:
                try:
                    packet = self._socket.recv(65536)
                except TimeoutError:
                    continue
                now = time.perf_counter()
                for message in read_messages(packet):
                    if (frame := assembler.take(message)) is not None:
                        self.frames.append(frame)
                        self.times.append(now)

    def close(self) -> None:
        """End."""
        self._ends = True
        self._thread.join()

    def wait(self, frames: int, *, seconds: float = 30.0) -> None:
        """Until so many frames have come."""
        end = time.perf_counter() + seconds
        while len(self.frames) < frames:
            assert time.perf_counter() < end, f"{len(self.frames)} of {frames} frames came"
            time.sleep(0.01)

    def joints(self) -> np.ndarray:
        """Positions of all frames (frames, joints, 3)."""
        return np.array([frame.joint_positions() for frame in self.frames])

    def lateness(self) -> np.ndarray:
        """By frame, seconds behind the schedule that the stream's own times make with the median frame."""
        behind = np.array(self.times) - [frame.seconds for frame in self.frames]
        return behind - np.median(behind)


@contextmanager
def engine(port: int) -> Iterator[Engine]:
    """An engine at a port."""
    result = Engine(port)
    try:
        yield result
    finally:
        result.close()
