"""Protocols of learned models. Subclass one to write a model: its abstract methods are all that must be written, the
rest has defaults.

Everywhere below, features are frames of `mapctl.features.LAYOUT` at PRIOR_FPS: `size` numbers, physical units (metres
and radians, steps and turns by frame): the first `continuous` are real-valued, the last two are contact bits, 0 or 1,
of the left and the right toe. Tensors are float32 on the CPU, batch first; no batch row depends on another.
"""

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeAlias, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from typing_extensions import TypeVar  # with a default before Python 3.13; torch brings it

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.recording import Capture, CaptureProposal

AnyState = TypeVar("AnyState", bound="DensityState")


@runtime_checkable
class DensityState(Protocol):
    """Memory of the frames so far, one batch row for each independent motion; never changed in place."""

    last_frame: Float[Tensor, "batch size"]
    """Features of the last frame seen."""

    @property
    def batch(self) -> int:
        """Number of independent states."""
        return len(self.last_frame)

    @abstractmethod
    def pick(self: AnyState, rows: Int[Tensor, " picked"]) -> AnyState:
        """Return the states of some batch rows, in that order; a row may be named more than once."""
        ...

    def expand(self: AnyState, count: int) -> AnyState:
        """Return a batch of `count`: copies of a batch of one, or the state itself if it has as many.

        ValueError for any other batch.
        """
        if self.batch == count:
            return self
        if self.batch != 1:
            raise ValueError(f"a state of batch {self.batch} cannot serve a batch of {count}")
        return self.pick(torch.zeros(count, dtype=torch.long))


@dataclass(frozen=True, eq=False)
class LastFrameState(DensityState):
    """State of a density that remembers nothing but the last frame."""

    last_frame: Float[Tensor, "batch size"]
    """Features of the last frame seen."""

    def pick(self, rows: Int[Tensor, " picked"]) -> "LastFrameState":
        return LastFrameState(self.last_frame[rows])


State = TypeVar("State", bound=DensityState, default=Any)


@dataclass(frozen=True, eq=False)
class DiscreteChoices:
    """The discrete choices along a rollout, fixed while its noise is optimised."""

    component: Int[Tensor, "batch frames"]
    """Mixture component of each frame; 0 where a density has only one."""
    contacts: Bool[Tensor, "batch frames 2"]
    """Left and right toe planted."""


@dataclass(frozen=True, eq=False)
class InitialStates(Generic[State]):
    """Moments of mocap from which a motion may begin: a density's states after part of a clip."""

    state: State
    """A density's state, one batch row a start."""
    speed: Float[Tensor, " starts"]
    """Mean speed over the second before, m/s."""
    names: tuple[str, ...]
    """The clip each was taken from."""
    weight: Float[Tensor, " starts"]
    """Share of the data that each represents, all together 1: drawn by it, motions begin as the data do."""


@dataclass(frozen=True)
class DataLimits:
    """Ranges of the training data, so that an infeasible request is refused with numbers."""

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


class PreparedRollout:
    """Rollouts of one density from one state under one plan, for a search that asks for many, one after the other.

    Autograd differentiates the density's own `rollout`; a density with a pullback of its own subclasses this.
    """

    def __init__(self, density: "Density[Any]", state: Any, plan: DiscreteChoices):
        self._prior, self._state, self._plan = density, state, plan
        self._graph: tuple[Tensor, tuple[Tensor, Tensor]] | None = None

    def roll_out(
        self, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Return features and log densities (nats) as `Density.rollout`, detached."""
        noise = noise.detach().requires_grad_(True)
        features, log_density = self._prior.rollout(self._state, noise, self._plan)
        self._graph = noise, (features, log_density)
        return features.detach(), log_density.detach()

    def pull_back(
        self, d_features: Float[Tensor, "batch frames size"], d_log_density: Float[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames continuous"]:
        """Return the gradient on the noise of the last `roll_out` from those on its features and log densities."""
        assert self._graph is not None, "there is no rollout yet"
        noise, rolled = self._graph
        depends = [(out, d) for out, d in zip(rolled, (d_features, d_log_density), strict=True) if out.requires_grad]
        outputs, gradients = zip(*depends, strict=True)
        (gradient,) = torch.autograd.grad(outputs, noise, gradients, materialize_grads=True)
        return gradient


@runtime_checkable
class Density(Protocol[State]):
    """A density over the next frame given those before, which an explicit state sums up; the prior of a MAP problem.

    Densities never change: methods that condition one return a new one. They are compared by identity, so a dataclass
    needs eq=False. Methods take a state with as many batch rows as the other arguments.
    """

    name: str
    """Name by which it was requested, for reports; different among the densities of one problem."""
    limits: DataLimits
    """Speeds and turning that its training data show."""
    initial_states: InitialStates[State]
    """States to begin from, at least one."""

    @abstractmethod
    def start_after(self, last_frame: Float[Tensor, "batch size"]) -> State:
        """Return a state that has seen one frame and remembers nothing before it."""
        ...

    @abstractmethod
    def advance(self, state: State, committed: Float[Tensor, "batch frames size"]) -> State:
        """Return the state after one or more further frames were seen, without gradient."""
        ...

    @abstractmethod
    def log_prob(self, features: Float[Tensor, "batch frames size"], state: State) -> Float[Tensor, "batch frames"]:
        """Compute the log density of each frame given those before it, contact bits included; differentiable in both.
        In nats, of features divided by `feature_std`."""
        ...

    @abstractmethod
    def plan(self, state: State, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """Choose the likeliest component and contact bits of each frame along the rollout that the noise gives."""
        ...

    @abstractmethod
    def rollout(
        self, state: State, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Roll out features x = mu_k + sigma_k noise with the plan's components k and contacts, and their log density
        under these (nats, as `log_prob`); both differentiable in the noise.

        Standard normal noise gives the density itself, zero noise its plain continuation. A sigma may be a matrix.
        """
        ...

    def prepare_rollout(self, state: State, plan: DiscreteChoices) -> PreparedRollout:
        """Prepare the rollouts of a search: a density with a pullback of its own offers it here. Default: autograd."""
        return PreparedRollout(self, state, plan)

    def plan_search(
        self, state: State, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[DiscreteChoices, PreparedRollout]:
        """Plan along the rollout of a search's first noise, and prepare rollouts under that plan."""
        plan = self.plan(state, noise)
        return plan, self.prepare_rollout(state, plan)

    @abstractmethod
    def latents(
        self, features: Float[Tensor, "batch frames size"], state: State
    ) -> tuple[DiscreteChoices, Float[Tensor, "batch frames continuous"]]:
        """Find the plan and the noise whose rollout is the features; the inverse of `rollout`, without gradient."""
        ...

    def sample(
        self, state: State, frames: int, generator: torch.Generator, *, temperature: float = 1.0
    ) -> tuple[Float[Tensor, "batch frames size"], State]:
        """Draw frames one after the other, and the state after them; the same generator gives the same frames.

        `temperature` is a factor of the noise; at 0 there is none. Default: a rollout of normal noise with the
        likeliest discrete choices.
        """
        noise = temperature * torch.randn(state.batch, frames, LAYOUT.continuous, generator=generator)
        with torch.no_grad():
            features, _ = self.rollout(state, noise, self.plan(state, noise))
        return features, self.advance(state, features)

    def sample_planted(
        self, state: State, frames: int, generator: torch.Generator, *, temperature: float = 1.0, sigma_speed: float
    ) -> tuple[Float[Tensor, "batch frames size"], State]:
        """Draw frames as `sample`, `temperature` a factor of the noise, given that toes stand where their contact bits
        are 1: their speed is zero with an error of `sigma_speed`, m/s, in each coordinate. Default: `sample`."""
        return self.sample(state, frames, generator, temperature=temperature)

    def infer_state(self, features: Float[Tensor, "frames size"]) -> State:
        """Find the state (batch of one) before a motion's first frame that makes the motion likely.

        Default: an empty memory, and a frame before the first that is as the first.
        """
        return self.start_after(features[:1])

    @property
    def feature_std(self) -> Float[Tensor, " size"]:
        """Physical size of the unit in which `log_prob` takes each feature. Default: ones, physical units."""
        return torch.ones(LAYOUT.size)

    @property
    def reference_log_density(self) -> float:
        """Log density a frame (nats, physical units, with a proposal's observation noise) below which motion is not
        like the training data, so that the density counts less. Default: minus infinity, it always counts in full."""
        return -math.inf

    def with_observation_noise(self, sigma: Float[Tensor, " continuous"]) -> "Density[State]":
        """Return the density of motion observed with independent errors of this sigma (physical units); its
        rollouts may stay as they are. Default: itself, for a density that is not sharper than proposals are accurate.
        """
        return self

    @property
    def labels(self) -> Mapping[str, Sequence[str]]:
        """Values by group (gait, style, pace) that it can be conditioned on. Default: none."""
        return {}

    def conditioned_on(self, labels: Sequence[str]) -> "Density[State]":
        """Return the density given labels of its data (`run`, `style=active`) beside those it is given already, with
        initial states to match; RequestError for a label that it does not know. Default: refuse all."""
        if labels:
            raise RequestError(f"the prior {self.name!r} has no label {labels[0]!r}, nor any other")
        return self

    def conditioned_like_start(self, start: int) -> "Density[State]":
        """Return the density given the labels of the clip that an initial state, of the index `start`, was taken from.
        Default: itself."""
        return self

    @property
    def pace_rates(self) -> Mapping[tuple[str, str], float]:
        """Changes of pace a second in its data, by the pace before and after, where paces (stand, walk, run) are labels
        `pace=...` of it. Default: none."""
        return {}

    def warm_up(self) -> None:
        """Load or compile what the first use would, so that no clock counts it. Default: nothing."""


AnyDensity: TypeAlias = Density[Any]
"""A density whose states have any type."""


@runtime_checkable
class Inbetweener(Protocol):
    """Proposes the frames and joints that a motion lacks; the MAP problem then makes the proposal exact."""

    @property
    def rough(self) -> "Inbetweener":
        """A cheaper in-betweener whose trajectory foretells this one's. Default: itself."""
        return self

    @property
    def has_style(self) -> bool:
        """Whether it is conditioned on motion DNA; gaps that others would do as well then go to it. Default: no."""
        return False

    @abstractmethod
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose a motion of the query's frames without gaps; what is drawn is drawn from the generator, or from a
        new one with seed 0. The proposal names the model of each gap, with the reason where it is another."""
        ...


@runtime_checkable
class PathPredictor(Protocol):
    """Predicts the root trajectory from the motion of the body about it (Zhou et al. 2020, section 3.4)."""

    @abstractmethod
    def predict(self, motion: LocalMotion) -> RootTrajectory:
        """Predict steps, heights and contacts of every frame, of motions of any length; frames that are not present
        are ignored, and their values may be anything finite.
        """
        ...


@runtime_checkable
class Denoiser(Protocol):
    """Proposes the motion behind a capture with noise and missing joints."""

    @abstractmethod
    def clean(self, capture: Capture) -> CaptureProposal:
        """Propose a motion of the capture's frames (two or more), on canonical bones at PRIOR_FPS, for each batch row.

        What was not observed by the capture's masks is ignored, and proposed as well.
        """
        ...


@runtime_checkable
class Refiner(Protocol):
    """Makes a synthesised motion look captured without changing what it does."""

    @abstractmethod
    def stream(self, pieces: Iterable[Float[Tensor, "batch _ size"]]) -> Iterator[Float[Tensor, "batch _ size"]]:
        """Refine consecutive pieces of one motion, in memory that does not grow; contact bits are 0 or 1.

        As many frames come out as went in, a fixed number of frames behind, cut into pieces in any way.
        """
        ...

    def refine(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch frames size"]:
        """Refine a whole motion. Default: `stream` of one piece."""
        return torch.cat(list(self.stream([features])), dim=1)
