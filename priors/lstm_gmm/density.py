"""A loaded LSTM-GMM as the solver uses it: the reference network, its fast path, its initial states and its card."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.metrics.gait import CHANGES, PACES, find_pace, label_pace
from mapctl.protocols import DataLimits, Density, DiscreteChoices, InitialStates, PreparedRollout
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsSettings, differentiate, minimise
from priors import checkpoints
from priors.lstm_gmm.fast import FastRollout
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig, LstmState

_OTHER_SIDE = {"left": "right", "right": "left"}


@dataclass(frozen=True, eq=False)
class Labels:
    """Which labels hold for which clip."""

    names: tuple[str, ...]
    """Labels as `group=value`, sorted: gait=run, style=active."""
    held: Float[Tensor, "clips labels"]
    """1 where a label holds."""

    @staticmethod
    def none(clips: int) -> "Labels":
        """Return no labels, for so many clips."""
        return Labels((), torch.zeros(clips, 0))

    @property
    def groups(self) -> Float[Tensor, "groups labels"]:
        """1 where a label belongs to a group."""
        kinds = [name.split("=")[0] for name in self.names]
        return torch.tensor([[float(kind == group) for kind in kinds] for group in dict.fromkeys(kinds)])

    @property
    def mirrored(self) -> list[int]:
        """Index of each label's mirror image: left and right are swapped where both are known."""
        swapped = [re.sub("left|right", lambda side: _OTHER_SIDE[side[0]], name) for name in self.names]
        return [self.names.index(other) if other in self.names else i for i, other in enumerate(swapped)]

    def renamed(self, names: tuple[str, ...]) -> "Labels":
        """Return the clips under other labels; a label of only one of both holds for no clip."""
        held = torch.zeros(len(self.held), len(names))
        for column, name in enumerate(names):
            if name in self.names:
                held[:, column] = self.held[:, self.names.index(name)]
        return Labels(names, held)


def read_labels(clips: Sequence[str], pattern: str) -> Labels:
    """Read labels from clips' names by the named groups of a regular expression; an empty pattern reads none.

    RequestError where it is no regular expression, has no named group or matches no clip.
    """
    if not pattern:
        return Labels.none(len(clips))
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise RequestError(f"labels must be a regular expression, got {pattern!r} ({error})") from error
    if not compiled.groupindex:
        raise RequestError(f"labels need named groups as in (?P<style>[a-z]+), got {pattern!r}")
    found = [_parse_match(compiled.search(name)) for name in clips]
    names = tuple(sorted(set().union(*found)))
    if not names:
        raise RequestError(f"the labels {pattern!r} match no clip, such as {clips[0]!r}")
    return Labels(names, torch.tensor([[float(name in clip) for name in names] for clip in found]))


def _parse_match(match: re.Match[str] | None) -> set[str]:
    if match is None:
        return set()
    return {f"{group}={value}" for group, value in match.groupdict().items() if value}


PACE_LABELS = tuple(map(label_pace, PACES))
"""Labels of PACES."""


def read_pace_rates(holds: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    """Read changes a second from one pace to another, by both paces, from what a card lists of its clips. None of
    a pace that they hold for less than the 0.3 s to which a card rounds."""
    minutes = holds["minutes by pace"]
    return {
        (before, after): holds[name] / (60 * minutes[before])
        for (before, after), name in CHANGES.items()
        if minutes[before] > 0 and minutes[after] > 0
    }


_MIN_STD = 0.05  # least standard deviation of a unit of the memory: some hardly vary in the data
_INFERRED_FRAMES = 10  # of a motion that has as many, which are to be likely after the state
_SEARCH, _BUDGET = LbfgsSettings(max_iterations=30), Budget(evaluations=40)


@dataclass(frozen=True, eq=False, repr=False)
class LstmGmmDensity(checkpoints.LoadedModel, Density[LstmState]):
    """The network as a density; rollouts take the fast path unless `use_fast` is off."""

    name: str
    """Name, file or run folder by which it was requested."""
    reference: LstmGmm
    """The torch network: specification of the fast path, and the only path on a GPU."""
    initial_states: InitialStates[LstmState]
    """States after moments of mocap, to begin from."""
    limits: DataLimits
    """Speeds and turning that the training data show."""
    card: checkpoints.Card
    """Card of the weights: configuration, data, licence, quality."""
    use_fast: bool = True
    """Whether rollouts and samples take the hand-written kernels."""
    unconditioned: "LstmGmmDensity | None" = None
    """Density of which this is a conditioned copy: both read the same packed weights."""

    @staticmethod
    def load(name: str) -> "LstmGmmDensity":
        """Load a bundled prior, or a trained one by its file or run folder; CheckpointError for anything else."""
        with checkpoints.open_checkpoint(name, "lstm-gmm", called="density") as (tensors, card):
            starts = InitialStates(
                LstmState(*(tensors.pop(f"starts.{part}") for part in ("previous", "hidden", "cell"))),
                tensors.pop("starts.speed"),
                tuple(card.data["starts"]),
                tensors.pop("starts.weight"),
            )
            config, count = LstmGmmConfig.of_card(card.config), len(starts.names)
            given = [tuple(each.shape) for each in (*vars(starts.state).values(), starts.speed, starts.weight)]
            if not count or given != [(count, LAYOUT.size), *[(2, count, config.width)] * 2, (count,), (count,)]:
                raise RequestError(f"its initial states are not those of {count} clips")
            network = checkpoints.build_network(LstmGmm, config, tensors)
            density = LstmGmmDensity(name, network, starts, DataLimits(**card.abilities), card)
            _ = density.pace_rates, density.reference_log_density  # raise what is wrong with the card's figures
        return density

    @cached_property
    def _fast(self) -> FastRollout:
        """The kernels, built on first use."""
        return FastRollout(self.reference, relative=self.unconditioned and self.unconditioned._fast)

    @property
    def _rollout_engine(self) -> FastRollout | LstmGmm:
        return self._fast if self.use_fast else self.reference

    def warm_up(self) -> None:
        """Load the kernels of the fast path, if it is taken."""
        _ = self._rollout_engine

    @property
    def feature_mean(self) -> Float[Tensor, " size"]:
        """Mean of the training data, physical units."""
        return self.reference.mean

    @property
    def feature_std(self) -> Float[Tensor, " size"]:
        """Standard deviation of the training data, physical units."""
        return self.reference.std

    @property
    def labels(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for name in self.reference.config.labels:
            group, _, value = name.partition("=")
            found.setdefault(group, []).append(value)
        return found

    def conditioned_on(self, labels: Sequence[str]) -> "LstmGmmDensity":
        full, starts = [self._label(name) for name in labels], self.initial_states
        known = read_labels(starts.names, self.card.data.get("labels", "")).renamed(tuple(full))
        paces = [[label_pace(find_pace(speed)) == label for label in full] for speed in starts.speed.tolist()]
        fitting = (known.held + torch.tensor(paces).reshape(known.held.shape)).sum(-1)
        rows = (fitting == fitting.max()).nonzero()[:, 0]
        weight = starts.weight[rows]
        picked = InitialStates(
            starts.state.pick(rows),
            starts.speed[rows],
            tuple(starts.names[i] for i in rows.tolist()),
            weight / weight.sum(),
        )
        return replace(self._with_network(self.reference.conditioned_on(full)), initial_states=picked)

    def conditioned_like_start(self, start: int) -> "LstmGmmDensity":
        pattern = self.card.data.get("labels", "")
        given = _parse_match(re.search(pattern, self.initial_states.names[start])) if pattern else set()
        known = sorted(given & {*self.reference.config.labels})
        return self._with_network(self.reference.conditioned_on(known))

    @property
    def pace_rates(self) -> dict[tuple[str, str], float]:
        held, given = self.card.data.get("holds", {}), {*PACE_LABELS} <= {*self.reference.config.labels}
        return read_pace_rates(held) if given and "minutes by pace" in held else {}

    def with_observation_noise(self, sigma: Float[Tensor, " continuous"]) -> "LstmGmmDensity":
        return self._with_network(self.reference.with_observation_noise(sigma))

    @property
    def reference_log_density(self) -> float:
        """Log density a frame (physical units, see mapctl.problem.density_selection) that 98 % of the windows of its
        own held-out data reach, observed with errors of `proposal_sigma()`; minus infinity where the card has none.
        """
        return float(self.card.quality.get("windows", {}).get("p2", -math.inf))

    def _with_network(self, network: LstmGmm) -> "LstmGmmDensity":
        """Return this with a copy of its network."""
        return replace(self, reference=network, unconditioned=self.unconditioned or self)

    def _label(self, name: str) -> str:
        """Find the label `group=value` of a name, which may be the value alone; RequestError unless there is one."""
        found = [label for label in self.reference.config.labels if name in (label, label.split("=", 1)[-1])]
        if len(found) > 1:
            raise RequestError(f"the prior {self.name!r} has several labels {name!r}; choose {' or '.join(found)}")
        if found:
            return found[0]
        if not self.labels:
            raise RequestError(f"the prior {self.name!r} has no label {name!r}, nor any other")
        group, equals, value = name.partition("=")
        if not equals or group not in self.labels:
            group, value = " or ".join(self.labels), name
        values = "; ".join(f"{kind}: {', '.join(values)}" for kind, values in self.labels.items())
        raise RequestError(f"the prior {self.name!r} has no {group} {value!r}, only {values}")

    def start_after(self, last_frame: Float[Tensor, "batch size"]) -> LstmState:
        return self.reference.start_after(last_frame)

    def infer_state(self, features: Float[Tensor, "frames size"]) -> LstmState:
        """Find a state (batch of one) before a motion that makes its first frames likely (Wang et al. 2019, Eq. 26).

        The frame before the first is taken to equal the first. The result is never less likely, a prior of the memory
        included, than the best of the initial states; the same input gives the same state.
        """
        known, first, wanted = self.initial_states.state, features[:1], features[None, :_INFERRED_FRAMES]
        memory = torch.cat([known.hidden, known.cell], dim=-1)
        centre, sigma = memory.mean(dim=1), memory.std(dim=1, correction=0).clamp_min(_MIN_STD)

        def state_of(unknowns: Float[Tensor, "batch unknowns"]) -> LstmState:
            memory = centre[:, None] + sigma[:, None] * unknowns.unflatten(-1, tuple(centre.shape)).transpose(0, 1)
            hidden, cell = memory.chunk(2, dim=-1)
            return LstmState(first.expand(len(unknowns), -1), hidden.contiguous(), cell.contiguous())

        def energy(unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
            nats = self.log_prob(wanted.expand(len(unknowns), -1, -1), state_of(unknowns)).sum(-1)
            return 0.5 * unknowns.square().sum(-1) - nats

        with torch.no_grad():
            starts = ((memory - centre[:, None]) / sigma[:, None]).transpose(0, 1).flatten(1)
            start = starts[energy(starts).argmin()][None]
        found = minimise(differentiate(energy), start, settings=_SEARCH, meter=Meter(_BUDGET))
        return state_of(found.x)

    def log_prob(self, features: Float[Tensor, "batch frames size"], state: LstmState) -> Float[Tensor, "batch frames"]:
        return self.reference.log_prob(features, state)

    def advance(self, state: LstmState, committed: Float[Tensor, "batch frames size"]) -> LstmState:
        return self.reference.advance(state, committed)

    def sample(
        self, state: LstmState, frames: int, generator: torch.Generator, *, temperature: float = 1.0
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        return self._rollout_engine.sample(state, frames, generator, temperature=temperature)

    def sample_planted(
        self, state: LstmState, frames: int, generator: torch.Generator, *, temperature: float = 1.0, sigma_speed: float
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        """Draw frames as `sample`, `temperature` a factor of the noise, given that planted toes stand (see
        `condition_on_standing`): by the network, not the kernels. `sigma_speed` is the error of their speed in each
        coordinate, m/s."""
        return self.reference.sample(state, frames, generator, temperature=temperature, sigma_speed=sigma_speed)

    def latents(
        self, features: Float[Tensor, "batch frames size"], state: LstmState
    ) -> tuple[DiscreteChoices, Float[Tensor, "batch frames continuous"]]:
        return self.reference.latents(features, state)

    def plan(self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        return self._rollout_engine.plan(state, noise)

    def rollout(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        return self._rollout_engine.rollout(state, noise, plan)

    def prepare_rollout(self, state: LstmState, plan: DiscreteChoices) -> PreparedRollout:
        return self._fast.prepare(state, plan) if self.use_fast else super().prepare_rollout(state, plan)

    def plan_search(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[DiscreteChoices, PreparedRollout]:
        return self._fast.plan_window(state, noise) if self.use_fast else super().plan_search(state, noise)
