"""What is known before a window: what a parametrisation of its frames builds trials from."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.problem.density_selection import DensityEnsemble
from mapctl.protocols import Density, DensityState
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class WindowContext:
    """Everything before a window that its frames depend on."""

    density: Density | DensityEnsemble
    """The prior, or several."""
    state: DensityState | tuple[DensityState, ...]
    """The prior's state after the committed frames, batch of one or one row for each candidate; a tuple of several."""
    place: GroundPose
    """Ground pose of the last committed frame."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last committed frames, metres."""
    frames: int
    """Number of frames in the window."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = PRIOR_FPS
    """Frames per second."""
    contacts_before: Bool[Tensor, "*batch 2"] = field(default_factory=lambda: torch.zeros(2, dtype=torch.bool))
    """Left and right toe planted in the last committed frame; unbatched or one row for each candidate."""
    first_frame: int = 0
    """Frame of the whole motion that the window begins at, counted from 0."""

    @property
    def prior(self) -> Density:
        """The one density; MapctlError where there are several or none."""
        if isinstance(self.density, DensityEnsemble):
            raise MapctlError("a rollout needs one density")
        return self.density

    @property
    def prior_state(self) -> DensityState:
        """The one density's state."""
        assert not isinstance(self.state, tuple)
        return self.state

    def expand_state(self, batch: int) -> DensityState:
        """The one density's state for a batch of candidates."""
        return self.prior_state.expand(batch)

    def build_trial(
        self,
        features: Float[Tensor, "batch frames size"],
        contacts: Bool[Tensor, "batch frames 2"],
        *,
        noise: Tensor | None,
        log_density: Tensor | None,
    ) -> Trial:
        """The trial of candidate features in this context."""
        return Trial(
            features,
            self.place,
            contacts=contacts,
            noise=noise,
            log_density=log_density,
            before=self.before,
            contacts_before=self.contacts_before,
            skeleton=self.skeleton,
            fps=self.fps,
            first_frame=self.first_frame,
        )
