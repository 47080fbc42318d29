"""Relay of a tracker's stream over the VMC protocol: bones of the body are smoothed, all else passes unchanged."""

from collections.abc import Iterable

import numpy as np

from mapctl.streaming.messages import Message, is_number
from mapctl.streaming.sender import (
    AVAILABLE,
    BONE,
    BONE_NAMES,
    FRAME,
    MIRROR,
    OK,
    ROOT,
    TIME,
    bundle,
    pack,
    read_transform,
)
from mapctl.streaming.smoothing import PoseSmoother

_JOINTS = (ROOT, *BONE_NAMES, "UpperChest")
_INDEX = {name: index for index, name in enumerate(_JOINTS)}
_MOVING = 2  # of them: the root and the hips
_FARTHEST = 1e4  # metres, and the most that a component of a rotation can be
_LEAST_NORM = 1e-3  # of a rotation


class PoseRelay:
    """Relay of one character, of messages to packets: it has no socket and no clock."""

    def __init__(self, delay: float):
        """Begin without poses; they are `delay` seconds behind."""
        self.smoother = PoseSmoother(len(_JOINTS), _MOVING, delay)
        self._latest: dict[int, tuple[object, ...]] = {}
        self._ok = Message(OK, AVAILABLE)

    def take(self, messages: Iterable[Message], seconds: float) -> list[bytes]:
        """Take messages that came at `seconds`; return packets of those that pass at once: blend shapes, fingers, eyes,
        cameras, devices, and whatever else there is."""
        passed: list[bytes] = []
        for message in messages:
            address, arguments = message.address, message.arguments
            joint = _INDEX.get(ROOT if address == ROOT else str(arguments[0])) if arguments else None
            if address == OK:
                self._ok = message
            elif address in (ROOT, BONE) and joint is not None:
                self._take_transform(joint, arguments, seconds)
            elif address not in (TIME, FRAME):
                passed.append(message.packed)
        return bundle(passed)

    def _take_transform(self, joint: int, arguments: tuple[object, ...], seconds: float) -> None:
        found = read_transform(arguments)
        if found is None or np.abs(found[1]).max() > _FARTHEST or np.linalg.norm(found[1][3:]) < _LEAST_NORM:
            return
        self._latest[joint] = arguments
        self.smoother.push(seconds, joint, found[1])

    def frame(self, seconds: float) -> list[bytes]:
        """Return the packets of the frame at `seconds`: root and bones as far as they are known, OK, and the time."""
        values, known = self.smoother.sample(seconds)
        if not known.any():
            return []
        messages: list[Message] = []
        for joint in np.flatnonzero(known[: len(_JOINTS)]).tolist():
            name, *numbers = self._latest[joint]
            row = np.array([*numbers[:3], *values[joint] * MIRROR[3:]], dtype=float)
            if joint < _MOVING:
                row[:3] = values[len(_JOINTS) + joint, :3] * MIRROR[:3]
            messages.append(
                Message(ROOT if joint == 0 else BONE, (name, *row.tolist(), *filter(is_number, numbers[7:])))
            )
        return pack([*messages, self._ok, Message(TIME, (float(seconds),))])
