"""Streams of poses over the VMC protocol (protocol.vmc.info, Marionette, version 2.5); `post` sends packets when due.

A bone has the name of Unity's HumanBodyBones, its position and rotation in its parent's frame, and no rotation in the
T-pose. Unity's space is left-handed: +Y up, a character faces +Z and its left hand is toward -X. Ours is its mirror
image through x = 0: a position (x, y, z) becomes (-x, y, z) and a rotation (x, y, z, w) becomes (x, -y, -z, w).

Addresses under `/mapctl/`, which other programs pass over, have what the protocol lacks, in our own axes. One opens
every packet of a frame, so that bones of two frames are never taken for one where packets were lost.
"""

import multiprocessing
import queue
import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from pythonosc.osc_message_builder import OscMessageBuilder

from mapctl import kinematics, rotations
from mapctl.features import PRIOR_FPS
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.processes import send_queued, spawn
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.streaming.messages import Endpoint, Message, is_number
from mapctl.streaming.post import StreamStatistics, run_post

OK, TIME, ROOT, BONE = "/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos", "/VMC/Ext/Bone/Pos"
"""Addresses: whether there is a character, the stream's time, the character's root, and one bone."""
APPLY = "/VMC/Ext/Blend/Apply"
"""Address that applies blend shapes, of which there are none: some receivers take it for the end of a frame."""
BONE_NAMES = tuple(name[0].upper() + name[1:] for name in CANONICAL.names)
"""Names of the canonical joints in Unity, in their order. There is no UpperChest: the neck hangs from the chest."""
FRAME, CONTACTS, VELOCITY, FORECAST = (f"/mapctl/{name}" for name in ("frame", "contacts", "root_velocity", "forecast"))
"""Addresses: the stream's time, which opens a packet; and `Guidance`."""
_GUIDANCE = (CONTACTS, VELOCITY, FORECAST)
_FORECAST_STEP = 5  # frames from one point of a streamed forecast to the next: a sixth of a second
AVAILABLE = (1, 3, 0)
"""Arguments of OK: a model is loaded, calibrated, in the normal mode."""
_ROOT_NAME = "root"
_TRANSFORM_NUMBERS = 7  # three of a position, four of a rotation
MIRROR = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0])
"""Factors that take a position and a rotation (xyzw) from canonical axes to the protocol's, and back."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """What the root and the feet do in a frame, and where the root will be, as numbers for a game's own logic."""

    contacts: Float[ndarray, "2"]
    """Left and right toe planted, 1 or 0."""
    root_velocity: Float[ndarray, "2"]
    """Velocity of the hips over the ground, x and z, m/s."""
    forecast: Float[ndarray, "points 3"]
    """Trajectory of the hips, a point each sixth of a second: x and z, metres, and heading, degrees."""

    def encode(self) -> list[Message]:
        """Return a message each."""
        values = ((CONTACTS, self.contacts), (VELOCITY, self.root_velocity), (FORECAST, self.forecast.ravel()))
        return [Message(address, tuple(map(float, numbers))) for address, numbers in values]

    @staticmethod
    def decode(numbers: Mapping[str, tuple[Any, ...]]) -> "Guidance | None":
        """Return the guidance of messages by their addresses; None where it is not whole, or of other sizes."""
        contacts, velocity, forecast = (np.array(numbers.get(one, (0.0,)), float) for one in _GUIDANCE)
        if (len(contacts), len(velocity), len(forecast) % 3) != (2, 2, 0):
            return None
        return Guidance(contacts, velocity, forecast.reshape(-1, 3))


def guide(chunk: FrameChunk) -> list[Guidance]:
    """Return the guidance of each frame of a step, whose forecast begins with the frames after it."""
    heading = rotations.split_heading(torch.from_numpy(chunk.quats[:, 0]))[0].numpy()
    ahead = np.concatenate([np.column_stack([chunk.root[:, ::2], heading]), chunk.trajectory])
    ahead[:, 2] = np.degrees(np.angle(np.exp(1j * ahead[:, 2])))
    points = [ahead[k + _FORECAST_STEP :: _FORECAST_STEP] for k in range(len(chunk.root))]
    return [Guidance(*each) for each in zip(chunk.contacts, chunk.root_velocity, points, strict=True)]


@dataclass(frozen=True, eq=False)
class VmcFrame:
    """One frame as it was received, in canonical axes."""

    seconds: float
    """Time of the stream, seconds."""
    root_position: Float[ndarray, "3"]
    """Position of the character's root in the world, metres."""
    root_quat_xyzw: Float[ndarray, "4"]
    """Orientation of the root."""
    bone_positions: Float[ndarray, "joints 3"]
    """Each canonical joint in its parent's frame, metres; the hips in the root's."""
    bone_quats_xyzw: Float[ndarray, "joints 4"]
    """Rotation of each canonical joint in its parent's frame."""
    guidance: Guidance | None = None
    """Contacts, velocity and forecast, where the sender is mapctl and sends them."""

    def joint_positions(self) -> Float[ndarray, "joints 3"]:
        """Return the world positions of the canonical joints, metres, from the bones alone."""
        root, turn, offsets, quats = (
            torch.from_numpy(values)
            for values in (self.root_position, self.root_quat_xyzw, self.bone_positions, self.bone_quats_xyzw)
        )
        hips = root + rotations.rotate(turn, offsets[0])
        quats = torch.cat([rotations.multiply(turn, quats[0])[None], quats[1:]])
        return kinematics.forward_kinematics(offsets, CANONICAL.parents, hips, quats)[0].numpy()


def encode_frame(
    skeleton: Skeleton,
    position: Float[ndarray, "3"],
    quats_xyzw: Float[ndarray, "joints 4"],
    seconds: float,
    *,
    root_travels: bool = False,
    guidance: Guidance | None = None,
) -> list[Message]:
    """Return the messages of one frame, with its guidance where there is some.

    `skeleton` has the canonical joints with the character's bones, `position` is its hips in the world, metres, and
    `quats_xyzw` are the joints' rotations in their parents' frames. The root stays at the origin and the hips travel;
    with `root_travels` the root is on the ground below the hips. The time comes last: it ends the frame.
    """
    ground = position * (1.0, 0.0, 1.0) if root_travels else np.zeros(3)
    positions = skeleton.offsets.numpy().copy()
    positions[0] = position - ground
    values = np.concatenate([positions, quats_xyzw], axis=-1) * MIRROR
    root = (*(ground * MIRROR[:3]).tolist(), 0.0, 0.0, 0.0, 1.0)
    bones = [Message(BONE, (name, *row)) for name, row in zip(BONE_NAMES, values.tolist(), strict=True)]
    ends = [Message(APPLY), Message(OK, AVAILABLE), Message(TIME, (float(seconds),))]
    return [Message(ROOT, (_ROOT_NAME, *root)), *bones, *(guidance.encode() if guidance else ()), *ends]


_PARTS = (ROOT, *BONE_NAMES)


@dataclass
class FrameAssembler:
    """Receiver's side: collects messages to frames. A frame of which a bone was lost is left out, and so is one that
    arrives among the packets of another."""

    _parts: dict[str, Float[ndarray, "7"]] = field(default_factory=dict)
    _numbers: dict[str, tuple[object, ...]] = field(default_factory=dict)
    _frame: tuple[object, ...] | None = None

    def take(self, message: Message) -> VmcFrame | None:
        """Take one message; return the frame that it completes. What is no pose, or no number, is passed over."""
        address, arguments = message.address, message.arguments
        if address == TIME:
            return self._complete(arguments)
        if address == FRAME and arguments != self._frame:
            self._forget()
            self._frame = arguments
        elif address in (ROOT, BONE) and (found := read_transform(arguments)) is not None:
            name = ROOT if address == ROOT else found[0]
            if name in _PARTS:
                self._parts[name] = found[1]
        elif address in _GUIDANCE and all(map(is_number, arguments)):
            self._numbers[address] = arguments
        return None

    def _forget(self) -> None:
        self._parts, self._numbers, self._frame = {}, {}, None

    def _complete(self, arguments: tuple[object, ...]) -> VmcFrame | None:
        parts, numbers, frame = self._parts, self._numbers, self._frame
        self._forget()
        if len(parts) < len(_PARTS) or not _are_numbers(arguments[:1]) or frame not in (None, arguments):
            return None
        root, rows = parts[ROOT], np.array([parts[name] for name in BONE_NAMES])
        seconds: Any = arguments[0]
        return VmcFrame(float(seconds), root[:3], root[3:], rows[:, :3], rows[:, 3:], Guidance.decode(numbers))


def read_transform(arguments: tuple[object, ...]) -> tuple[str, Float[ndarray, "7"]] | None:
    """Return name, position and rotation in canonical axes; what comes after them, as in version 2.1, means nothing."""
    name, numbers = arguments[:1], arguments[1 : 1 + _TRANSFORM_NUMBERS]
    if not name or not isinstance(name[0], str) or len(numbers) < _TRANSFORM_NUMBERS or not _are_numbers(numbers):
        return None
    return name[0], np.array(numbers, dtype=np.float64) * MIRROR


def _are_numbers(values: tuple[object, ...]) -> bool:
    return bool(values) and all(map(is_number, values))


LATE_SECONDS = 0.5 / PRIOR_FPS
"""A frame that is sent more than this after it was due is late: half the time for which it is shown."""
DEFAULT_DELAY = 0.1
"""Seconds by which the stream is behind: as late as steering lets frames be before it holds its time."""
OPTION = "--stream"
_MAX_BUNDLE_BYTES = 1200  # as VirtualMotionCapture itself: below what any network sends in one piece
_BUNDLE_HEAD = b"#bundle\0" + (1).to_bytes(8, "big")  # and the time at which it holds: at once
_MAX_QUEUED = 3000  # messages to a process that does not read: beyond them frames are lost
_END_SECONDS = 3.0


class PoseStream:
    """Frames of one or several characters, each sent to a port of its own: the endpoint's and those after it."""

    def __init__(
        self,
        endpoint: Endpoint,
        skeletons: Sequence[Skeleton],
        *,
        root_travels: bool = False,
        delay: float = DEFAULT_DELAY,
    ):
        """Start the process that sends. `skeletons` have the canonical joints; see `encode_frame` for
        `root_travels`.

        Every frame is sent `delay` seconds after it is to be seen here, so that one that is delivered late by less
        is sent in time. RequestError where the host is unknown, or there are not so many ports.
        """
        self.endpoints = [endpoint.offset(k, option=OPTION) for k in range(len(skeletons))]
        family, address = endpoint.resolve(option=OPTION)
        receivers = [(address, one.port) for one in self.endpoints]
        self._skeletons, self._root_travels, self._delay = list(skeletons), root_travels, delay
        self.statistics = StreamStatistics()
        """Summary of the messages sent; known after `close`."""
        self._ours, theirs = multiprocessing.Pipe()
        self._process = spawn(run_post, theirs, int(family), receivers, LATE_SECONDS)
        theirs.close()
        self._queue: queue.SimpleQueue[tuple[object, ...] | None] = queue.SimpleQueue()
        threading.Thread(target=send_queued, args=(self._ours, self._queue), daemon=True).start()

    def put(self, character: int, chunk: FrameChunk) -> None:
        """Send frames of a character, each when it is due, with its guidance (`guide`)."""
        if self._queue.qsize() > _MAX_QUEUED:
            return
        for k, guidance in enumerate(guide(chunk)):
            messages = encode_frame(
                self._skeletons[character],
                chunk.root[k],
                chunk.quats[k],
                chunk.seconds + k / PRIOR_FPS,
                root_travels=self._root_travels,
                guidance=guidance,
            )
            self._queue.put(("put", character, chunk.due_of(k) + self._delay, pack(messages)))

    def forget(self, character: int) -> None:
        """Send nothing of a character that has not been sent: it restarts."""
        self._queue.put(("forget", character))

    def close(self) -> None:
        """Send what still waits, each frame at its time, and end."""
        self._queue.put(("close",))
        self._queue.put(None)
        with suppress(OSError, EOFError):
            if self._ours.poll(self._delay + _END_SECONDS):
                self.statistics = self._ours.recv()
        self._process.join(0.5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._ours.close()


def pack(messages: Sequence[Message]) -> list[bytes]:
    """Pack the messages of a frame, the time last, into packets. Each begins with that time, by which a receiver finds
    the packets of a frame."""
    return bundle(map(encode, messages), encode(Message(FRAME, messages[-1].arguments)))


def bundle(packed: Iterable[bytes], opening: bytes = b"") -> list[bytes]:
    """Join packed messages, in order, to OSC bundles of at most 1200 bytes, if none of them is longer; each bundle
    begins with `opening`."""
    bundles, head = list[bytes](), _BUNDLE_HEAD + (_add_length(opening) if opening else b"")
    for element in map(_add_length, packed):
        if not bundles or len(bundles[-1]) + len(element) > _MAX_BUNDLE_BYTES:
            bundles.append(head)
        bundles[-1] += element
    return bundles


def _add_length(packed: bytes) -> bytes:
    return len(packed).to_bytes(4, "big") + packed


def encode(message: Message) -> bytes:
    """Return the bytes of a message."""
    if message.packed:
        return message.packed
    builder = OscMessageBuilder(message.address)
    for argument in message.arguments:
        builder.add_arg(argument)  # pyright: ignore[reportArgumentType]
    return builder.build().dgram
