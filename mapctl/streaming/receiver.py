"""Receiving of OSC messages from other programs, without waiting, and with a bound on what strangers can cost."""

import errno
import logging
import select
import socket
import time
from collections import deque
from collections.abc import Iterator, Sequence

from pythonosc.osc_packet import OscPacket

from mapctl.errors import RequestError
from mapctl.streaming.messages import Endpoint, Message

MAX_DATAGRAM_BYTES = 16384
"""Longer packets are dropped unread. A bundle of all bones and blend shapes of an avatar has half as many."""
OPTION = "--listen"
_MAX_READ, _MAX_KEPT = 512, 128  # packets that one look reads, and of which it keeps the newest
_LIBRARY = "pythonosc"


class OscReceiver:
    """A socket that is looked into as often as its owner likes. Of too many packets the newest count."""

    def __init__(self, endpoint: Endpoint, *, parse_seconds: float = 0.004):
        """Bind the socket; RequestError where the port is taken, or the host is not this machine's. One look takes
        `parse_seconds` at most to understand the packets."""
        self.endpoint, self._parse_seconds = endpoint, parse_seconds
        family, address = endpoint.resolve(option=OPTION)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind((address, endpoint.port))
        except OSError as error:
            self._socket.close()
            raise RequestError(_explain_bind_error(endpoint, error)) from error
        self._socket.setblocking(False)
        self.dropped = 0
        """Number of packets that were no messages, so far."""
        self.fault = ""
        """Fault of the last of them."""
        logging.getLogger().addFilter(_is_from_elsewhere)

    def poll(self) -> list[Message]:
        """Return the messages that came since the last look, oldest first. What is no OSC is counted in `dropped`."""
        end, found = time.perf_counter() + self._parse_seconds, list[list[Message]]()
        for datagram in reversed(self._read()):
            if time.perf_counter() > end:
                self._drop("too many packets")
                continue
            found.append(self._parse(datagram))
        return [message for messages in reversed(found) for message in messages]

    def wait(self, seconds: float) -> None:
        """Wait until a packet comes, for so many seconds at most."""
        select.select([self._socket], [], [], seconds)

    def close(self) -> None:
        """Close the socket."""
        logging.getLogger().removeFilter(_is_from_elsewhere)
        self._socket.close()

    def _read(self) -> Sequence[bytes]:
        kept = deque[bytes](maxlen=_MAX_KEPT)
        for _ in range(_MAX_READ):
            try:
                datagram = self._socket.recv(MAX_DATAGRAM_BYTES + 1)
            except BlockingIOError:
                break
            except OSError:  # Windows reports here that nothing received the last message
                continue
            if len(datagram) > MAX_DATAGRAM_BYTES:
                self._drop(f"a packet of more than {MAX_DATAGRAM_BYTES} bytes")
            else:
                kept.append(datagram)
        return list(kept)

    def _parse(self, datagram: bytes) -> list[Message]:
        try:
            return list(read_messages(datagram))
        except Exception as error:  # the library raises whatever Python does where bytes make no sense
            self._drop(f"a packet that is no OSC ({type(error).__name__})")
            return []

    def _drop(self, why: str) -> None:
        self.dropped += 1
        self.fault = why


def read_messages(datagram: bytes) -> Iterator[Message]:
    """Yield the messages of a packet that is known to be OSC, as a receiver of poses does."""
    for timed in OscPacket(datagram).messages:
        yield Message(timed.message.address, tuple(timed.message), timed.message.dgram)


def _is_from_elsewhere(record: logging.LogRecord) -> bool:
    """Return whether a warning is not the library's own, of which strangers could cause thousands."""
    return _LIBRARY not in record.pathname


def _explain_bind_error(endpoint: Endpoint, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"{OPTION}: port {endpoint.port} of {endpoint.host} is in use by another program; choose another"
    return f"{OPTION}: cannot listen on {endpoint}: {error.strerror or error}"
