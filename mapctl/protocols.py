"""What the core asks of learned models. A model has the roles it can fill; none is given a fake one."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl.inbetweening import PositionImage, ProposedPositions
from mapctl.recording import Capture, CaptureProposal

State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class DiscreteChoices:
    """The discrete choices along a rollout, fixed while its noise is optimised."""

    component: Int[Tensor, "batch frames"]
    """Mixture component of each frame."""
    contacts: Bool[Tensor, "batch frames 2"]
    """Left and right toe planted."""


@runtime_checkable
class Density(Protocol[State]):
    """A density over next frames with explicit state: what was seen so far, batch first."""

    def log_prob(
        self, features: Float[Tensor, "batch frames size"], state: State, *, inputs: Tensor | None = None
    ) -> Float[Tensor, "batch frames"]:
        """Log density (nats, normalised units) of each frame given those before it, or given noisy `inputs` of them."""
        ...

    def sample(
        self, state: State, frames: int, generator: torch.Generator, *, temperature: float = 1.0
    ) -> tuple[Float[Tensor, "batch frames size"], State]:
        """Frames drawn one after the other, and the state after them."""
        ...

    def advance(self, state: State, committed: Float[Tensor, "batch frames size"]) -> State:
        """The state after the committed frames were seen."""
        ...

    def plan(self, state: State, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """The likeliest discrete choices along the rollout that the noise gives."""
        ...

    def latents(
        self, features: Float[Tensor, "batch frames size"], state: State
    ) -> tuple[DiscreteChoices, Float[Tensor, "batch frames continuous"]]:
        """The plan and the noise whose rollout is the features."""
        ...

    def rollout(
        self, state: State, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Features x = mu_k + sigma_k noise with the plan's components k, and their log density; differentiable."""
        ...


@runtime_checkable
class Inbetweener(Protocol):
    """Proposes the frames and joints that a motion lacks."""

    def propose(self, image: PositionImage) -> ProposedPositions:
        """All joints in all frames; known ones may move."""
        ...


@runtime_checkable
class Denoiser(Protocol):
    """Proposes the motion behind a capture."""

    def clean(self, capture: Capture) -> CaptureProposal:
        """The proposal, of the capture's frames."""
        ...


@runtime_checkable
class Refiner(Protocol):
    """Makes a synthesised motion look captured without changing what it does."""

    def refine(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch frames size"]:
        """The refined frames."""
        ...

    def stream(self, pieces: Iterable[Float[Tensor, "batch piece size"]]) -> Iterator[Float[Tensor, "batch out size"]]:
        """The same frames, from consecutive pieces, some frames behind them, in memory that does not grow."""
        ...


@dataclass(frozen=True, eq=False)
class InitialStates:
    """Moments of mocap from which a density may begin: its state after a stretch of a clip."""

    state: Any
    """A density's state, one batch row a start."""
    speed: Float[Tensor, " starts"]
    """Mean speed over the second before, m/s."""
    names: tuple[str, ...]
    """The clip each was taken from."""
    weight: Float[Tensor, " starts"]
    """Share of the data that each stands for, all together 1: drawn by it, motions begin as the data do."""


@dataclass(frozen=True)
class DataLimits:
    """What the training data show, so that impossible wishes can be named with numbers."""

    slowest: float
    """Speed, m/s, 1st percentile of one-second means."""
    fastest: float
    """Speed, m/s, 99th percentile of one-second means."""
    turn_rate: float
    """Turning of the travel direction, rad/s, 99.5th percentile of one-second means."""

    @property
    def max_steering_speed(self) -> float:
        """Highest speed that is asked of the prior while steering, m/s: a tenth beyond what its data show."""
        return 1.1 * self.fastest
