"""What the panel asks of the show."""

from typing import Any, Protocol, runtime_checkable

from scenes.live.page.keys import KeyAction
from scenes.live.view.chase import CameraMode


@runtime_checkable
class ViewerActions(Protocol):
    """Requests that the panel can make."""

    def order(self, **changes: Any) -> None:
        """Change the chosen character's orders, and show them; it leaves its path."""
        ...

    def typed(self, **changes: Any) -> None:
        """Change orders from a control, which already shows them and may still be typed into."""
        ...

    def nudge(self, **by: float) -> None:
        """Add to the chosen character's speed (m/s) or heading (degrees), as far as it goes."""
        ...

    def choose(self, character: int) -> None:
        """Choose the character whose orders are shown and changed from now on."""
        ...

    def toggle_pause(self) -> None:
        """Stop everybody, or go on."""
        ...

    def reset(self) -> None:
        """Restart all characters."""
        ...

    def walk_path(self) -> None:
        """Let the chosen character walk the drawn path."""
        ...


@runtime_checkable
class TargetActions(Protocol):
    """Requests about what is reached for, looked at and walked round."""

    def aim(self, **changes: Any) -> None:
        """Change what the chosen character reaches for and looks at: `hand`, `looks`, `target`; it keeps its path."""
        ...

    def put_disc(self, radius: float | None) -> None:
        """Put a disc to walk round, of a radius in metres; None takes it away."""
        ...

    def bring(self) -> None:
        """Put target and disc before the chosen character."""
        ...


@runtime_checkable
class ViewActions(Protocol):
    """Requests about what is seen."""

    def act(self, action: KeyAction) -> None:
        """Do what a key does."""
        ...

    def set_camera(self, mode: CameraMode) -> None:
        """Have the camera turn with the character, follow it, or stay."""
        ...

    def show_all(self) -> None:
        """Bring everybody into view."""
        ...

    def set_keys(self, *, from_camera: bool) -> None:
        """Have W, A, S and D mean ways as the camera sees them, or faster, slower and turns."""
        ...

    def show_marks(self, shown: bool) -> None:
        """Show or hide arrows and trails."""
        ...

    def set_theme(self, name: str) -> None:
        """Change the colours: `light`, `dark`, or `auto` for what the browser prefers."""
        ...
