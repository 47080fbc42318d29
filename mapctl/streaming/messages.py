"""OSC messages as plain values, whoever carries them."""

from dataclasses import dataclass

Argument = object
"""An argument as it came: text, a number, or whatever else a program sent."""


@dataclass(frozen=True)
class Message:
    """One OSC message."""

    address: str
    """Address, as `/VMC/Ext/T`."""
    arguments: tuple[Argument, ...] = ()
    """Arguments, in order. A float is sent as 32 bits."""
