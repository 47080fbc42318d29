"""OSC messages as plain values, and the endpoint HOST:PORT at which they are sent or received."""

import math
import re
import socket
from dataclasses import dataclass, field

from mapctl.errors import RequestError

Argument = object
"""An argument as it came: text, a number, or whatever else a program sent."""


@dataclass(frozen=True)
class Message:
    """One OSC message."""

    address: str
    """Address, as `/VMC/Ext/T`."""
    arguments: tuple[Argument, ...] = ()
    """Arguments, in order. A float is sent as 32 bits."""
    packed: bytes = field(default=b"", compare=False, repr=False)
    """Its bytes, where it was received."""


def is_number(value: object) -> bool:
    """Return whether an argument is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


LOOPBACK = "127.0.0.1"
_TEXT = re.compile(r"(?:(?P<host>\[[^\]]*\]|[^:\[\]]*):)?(?P<port>\d{1,5})")
_MAX_PORT = 65535


@dataclass(frozen=True)
class Endpoint:
    """A host and a port of UDP."""

    host: str
    """A name or an address, as it was written; LOOPBACK where none was."""
    port: int
    """Port, 1 to 65535."""

    @staticmethod
    def parse(text: str, *, option: str) -> "Endpoint":
        """Parse `HOST:PORT`, `[IPV6]:PORT`, `:PORT` or `PORT`; RequestError names the option."""
        found = _TEXT.fullmatch(text.strip())
        if found is None or not 1 <= int(found["port"]) <= _MAX_PORT:
            raise RequestError(
                f"{option} must be HOST:PORT, or a port on this machine, from 1 to {_MAX_PORT}; got {text!r}"
            )
        return Endpoint((found["host"] or "").strip("[]") or LOOPBACK, int(found["port"]))

    def offset(self, by: int, *, option: str) -> "Endpoint":
        """Return the endpoint so many ports on; RequestError where there is no such port."""
        if self.port + by > _MAX_PORT:
            raise RequestError(f"{option}: character {by + 1} would be at port {self.port + by}; choose a lower port")
        return Endpoint(self.host, self.port + by)

    def resolve(self, *, option: str) -> tuple[socket.AddressFamily, str]:
        """Return the family and the numeric address; RequestError where the host is unknown."""
        try:
            found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            raise RequestError(f"{option}: the host {self.host!r} is not known ({_reason(error)})") from error
        family, _, _, _, address = found[0]
        return family, str(address[0])

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
