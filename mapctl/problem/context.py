"""What is known before a window."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class WindowContext:
    """What is known before the window."""

    density: Density
    """The prior."""
    state: Any
    """Its state after the committed frames; batch of one, or one for each candidate."""
    place: GroundPose
    """Of the last committed frame."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last committed frames, metres."""
    frames: int
    """Of the window."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = PRIOR_FPS
    """Frames per second."""

    def trial(self, features: Tensor, noise: Tensor, density: Tensor, contacts: Tensor) -> Trial:
        """A trial in this context."""
        planted = LAYOUT.pick(self.state.last_frame, "contacts") > 0.5
        return Trial(features, self.place, noise, density, contacts, self.before, self.skeleton, self.fps, planted)


def _expand_state(state: Any, batch: int) -> Any:
    """The state for a batch of candidates."""
    return state.expand(batch)
