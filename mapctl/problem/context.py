"""What is known before a window, from which parametrisations build trials; and the request to solve the window."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.problem.density_selection import DensityEnsemble
from mapctl.protocols import AnyDensity, DensityState
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class WindowContext:
    """What comes before a window, as far as its frames depend on it."""

    density: AnyDensity | DensityEnsemble
    """Density, or several of which the solver selects one."""
    state: DensityState | tuple[DensityState, ...]
    """Density's state after the committed frames, batch of one or one row a candidate; a tuple for an ensemble."""
    place: GroundPose
    """Ground pose of the last committed frame."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last committed frames, metres, oldest first."""
    frames: int
    """Number of frames in the window."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = PRIOR_FPS
    """Frames per second."""
    contacts_before: Bool[Tensor, "*batch 2"] = field(default_factory=lambda: torch.zeros(2, dtype=torch.bool))
    """Left and right toe planted in the last committed frame; unbatched or one row a candidate."""
    heels_before: Float[Tensor, "known 2 3"] = field(default_factory=lambda: torch.zeros(0, 2, 3))
    """World positions of the heels in the last committed frame, metres; none where it is not known."""
    first_frame: int = 0
    """Frame of the whole motion with which the window begins, from 0."""

    @property
    def prior(self) -> AnyDensity:
        """The one density; MapctlError for an ensemble."""
        if isinstance(self.density, DensityEnsemble):
            raise MapctlError("a rollout needs one density, not an ensemble")
        return self.density

    @property
    def prior_state(self) -> DensityState:
        """The one density's state."""
        assert not isinstance(self.state, tuple)
        return self.state

    def expand_state(self, batch: int) -> DensityState:
        """Expand the one density's state to a batch of candidates."""
        return self.prior_state.expand(batch)

    def build_trial(
        self,
        features: Float[Tensor, "batch frames size"],
        contacts: Bool[Tensor, "batch frames 2"],
        *,
        noise: Float[Tensor, "batch frames width"] | None,
        log_density: Float[Tensor, "batch frames"] | None,
        heel_plan: Trial | None = None,
    ) -> Trial:
        """Build the trial of candidate features, physical units, in this context; `heel_plan` as `Trial` has it."""
        return Trial(
            features,
            self.place,
            contacts=contacts,
            noise=noise,
            log_density=log_density,
            before=self.before,
            contacts_before=self.contacts_before,
            heels_before=self.heels_before,
            heel_plan=heel_plan,
            skeleton=self.skeleton,
            fps=self.fps,
            first_frame=self.first_frame,
        )

    def plan_heels(
        self, features: Float[Tensor, "batch frames size"], contacts: Bool[Tensor, "batch frames 2"]
    ) -> Trial:
        """Return the trial of a plan, whose poses and toes' contacts say which heels are planted, for `build_trial`."""
        return self.build_trial(features, contacts, noise=None, log_density=None)


@dataclass(frozen=True, eq=False)
class WindowRequest:
    """One window to solve."""

    context: WindowContext
    """What is known before the window."""
    terms: Sequence[Term]
    """Terms whose energies are summed over the window's frames."""
    warm_start: Float[Tensor, "ahead width"]
    """What the last window found for the first of these frames (see `Parametrisation.warm_start`); none at the start.
    """
    generator: torch.Generator
    """Source of all random draws."""
    seconds: float = math.inf
    """Time that is left, seconds."""
