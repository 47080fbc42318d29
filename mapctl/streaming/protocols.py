"""What a live show needs of streaming, so that it runs without the package python-osc too."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from numpy import ndarray

from mapctl.streaming.messages import Message


@runtime_checkable
class FrameStream(Protocol):
    """Destination of frames, each sent when it is due."""

    def put(
        self,
        character: int,
        due: float,
        seconds: float,
        root: Float[ndarray, "frames 3"],
        quats: Float[ndarray, "frames joints 4"],
    ) -> None:
        """Have frames of a character sent, the first at `due` (a value of time.perf_counter); `seconds` is the stream's
        time of the first, `root` the hips in the world, metres, and `quats` local rotations, xyzw."""
        ...

    def forget(self, character: int) -> None:
        """Send nothing of a character that has not been sent: it restarts."""
        ...

    def pause(self) -> None:
        """Take the time until the next frames for a pause."""
        ...


@runtime_checkable
class MessageSource(Protocol):
    """Source of messages from other programs."""

    dropped: int
    """Number of packets that were no messages, so far."""
    fault: str
    """What was wrong with the last of them."""

    def poll(self) -> list[Message]:
        """Return the messages that came since the last call, oldest first, at once."""
        ...
