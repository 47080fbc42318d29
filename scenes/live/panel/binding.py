"""What users do in the panel becomes calls.

Callbacks are coroutines: those run in the order in which browsers did things, others on threads in any order.
"""

from collections.abc import Callable
from typing import Any

import viser


def bind_control(handle: Any, action: Callable[[Any], None]) -> None:
    """Act when a user moves a control, on what it shows then; not when the panel itself moves it."""

    @handle.on_update
    async def _(event: viser.GuiEvent) -> None:
        if event.client_id is not None:
            action(handle.value)


def bind_button(button: viser.GuiButtonHandle, action: Callable[[], None]) -> None:
    """Act when a button is pressed."""
    bind_client_button(button, lambda client: action())


def bind_client_button(button: viser.GuiButtonHandle, action: Callable[[viser.ClientHandle | None], None]) -> None:
    """Act when a button is pressed, on the browser in which it was."""

    @button.on_click
    async def _(event: viser.GuiEvent) -> None:
        action(event.client)


def bind_hotkey(command: viser.CommandHandle, action: Callable[[], None]) -> None:
    """Act when a key is pressed, or its line of the palette is chosen."""

    @command.on_trigger
    async def _(event: Any) -> None:
        action()
