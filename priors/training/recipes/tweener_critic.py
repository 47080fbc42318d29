"""The critic of the generator of long in-betweens (Zhou et al. 2020, section 3.5, Eq. 7 and 8): it joins training by
distances at some step, and a guard keeps the best weights of all, those before it among them.
"""

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl import kinematics
from mapctl.errors import RequestError
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from priors.config import require_at_least
from priors.training.adversaries import body_motion
from priors.training.adversaries.body_motion import BodyMotionCritic
from priors.training.adversaries.guard import find_winner
from priors.training.adversaries.history import HistoryBuffer
from priors.training.augmentation.key_layouts import KeySettings, draw_windows
from priors.training.augmentation.pose_windows import PoseWindows
from priors.training.corpus import Corpus, Split
from priors.training.parallel import TrainingGroup
from priors.training.quality.gap import measure_kinds
from priors.training.recipe import Export, Gathered, Row
from priors.training.recipes.tweener import TweenerRecipe, TweenerTrainer
from priors.training.trainer import Trainer, draw_weights, make_divergence_error
from priors.tweening.generator import GeneratorNetwork, regularise_batch
from priors.tweening.keys import ToldParts, make_key_image

_ADAM = (0.5, 0.9)
_STRIDE = 2 ** len(body_motion.WIDTHS)  # frames for which the critic has a score
_JUDGED_CLIPS = 32  # windows of each set that the critic scores for the guard
_GAP = 120  # frames of the gaps that are compared before and after


@dataclass(frozen=True)
class CriticSettings:
    """When the critic joins, and how."""

    begin: int = 0
    """Step at which it joins."""
    ramp: float = 0.2
    """Share of the steps from then on over which its weight rises from a tenth to the whole."""
    weight: float = 1.0
    """Weight of what the generator wants to hear (Eq. 8)."""
    generator_rate: float = 1e-4
    """Learning rate of the generator from then on, which falls to nothing along a cosine."""
    rate: float = 2e-4
    """Learning rate of the critic."""
    half: float = 10.0
    """Frames from the nearest key at which what a performer did counts half from then on."""
    far: float = 0.15
    """What it counts at least."""
    frames: int = 126
    """Frames of a window that the critic sees; a score is of 94 (body_motion.FIELD)."""
    batch: int = 24
    """Windows of captured motion an update."""
    history: int = 192
    """Windows of made motion that are kept for it."""
    penalty: float = 1e-4
    """Weight of the critic's squared slope at captured motion."""
    penalised: int = 8
    """Steps from one such penalty to the next, each times as heavy."""
    noise: float = 0.05
    """Spread of what is added to all that it sees."""
    regularisation: float = 0.05
    """Weight of batch regularisation of its layers (Eq. 9)."""
    average: float = 0.999
    """Share of the past in the running mean of the generator's weights, which is what is kept."""

    def __post_init__(self):
        require_at_least(self, _STRIDE, "frames")
        require_at_least(self, 1, "batch", "history", "penalised")


class CriticisedTrainer(Trainer[GeneratorNetwork]):
    """A generator that learns by distances, and from some step on from a critic too. What is kept is the running mean
    of its weights."""

    def __init__(self, learner: TweenerTrainer, critic: CriticSettings):
        super().__init__(steps=learner.settings.steps, seed=learner.settings.seed)
        if learner.longest < critic.frames + 2:
            raise RequestError(
                f"the critic sees windows of {critic.frames + 2} frames; the longest there are have {learner.longest}"
            )
        self.learner, self.settings = learner, critic
        self.generator = self.common = learner.generator
        self.network, self.before = (deepcopy(learner.network).requires_grad_(False) for _ in range(2))
        self.critic = draw_weights(BodyMotionCritic, learner.settings.seed)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=critic.rate, betas=_ADAM)
        self.optimiser = torch.optim.Adam(learner.network.parameters(), lr=critic.generator_rate, betas=_ADAM)
        self.history: HistoryBuffer | None = None
        self._made: list[Tensor] = []

    def join(self, group: TrainingGroup) -> None:
        """Train as one of a group from here on, each with its part of the history."""
        super().join(group)
        self.learner.group, self.learner.common = self.group, self.common
        self.history = None if self.history is None else self.history.split(group)

    def set_first_steps(self, steps: int) -> None:
        """Set the steps that the run was begun with, where they are not those that it goes on to."""
        super().set_first_steps(steps)
        self.learner.set_first_steps(steps)

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        return {
            "averaged": self.network,
            "before": self.before,
            "generator": self.learner.network,
            "critic": self.critic,
        }

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """One by distances alone, and one for each side."""
        own = {"adversarial-optimiser": self.optimiser, "critic-optimiser": self.critic_optimiser}
        return self.learner.optimisers() | own

    def train_step(self) -> dict[str, float]:
        """One update by distances; from the step on at which the critic joins, one of each side.

        `critic` is its loss (Eq. 7, 2 where it knows nothing), `generator` Eq. 8, `told` the share that it tells apart.
        """
        if self.step < self.settings.begin:
            parts = self.learner.train_step()
            self.network.load_state_dict(self.learner.network.state_dict())
            self.before.load_state_dict(self.learner.network.state_dict())
            self.step = self.learner.step
            return parts | {"generator": 0.0, "critic": 2.0, "told": 0.5}
        if self.step == self.settings.begin:
            self.learner.shortest = self.settings.frames + 2
        parts = self._improve()
        parts |= self._criticise()
        self.step = self.learner.step = self.step + 1
        return parts

    def validate(self, corpus: Corpus) -> Row:
        """Gaps of unseen clips by the weights before the critic and by those of now, how far it has moved the motion
        between keys, cm, and what it gives clips of training, unseen ones and what is made."""
        kinds = self.learner.settings.kinds
        row = measure_kinds(self.network, corpus, kinds)
        if self.step <= self.settings.begin:
            return row
        before = {f"before_{name}": value for name, value in measure_kinds(self.before, corpus, kinds).items()}
        return row | before | self._measure_critic(corpus)

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs, but the step."""
        kept = {} if self.history is None else {"history": self.group.gather(self.history.windows)}
        return super().state() | kept

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` gave; KeyError or RuntimeError where it is not whole."""
        super().load_state(tensors, step)
        self.learner.step = step
        if "history" in tensors:
            self.history = HistoryBuffer(tensors["history"])
        if step > self.settings.begin:
            self.learner.shortest = self.settings.frames + 2

    def _share_done(self, steps: int) -> float:
        """Share of the steps with the critic that are done, of so many in all."""
        return (self.step - self.settings.begin) / max(1, steps - self.settings.begin)

    def _improve(self) -> dict[str, float]:
        """One update of the generator, and of its running mean."""
        self._made = []
        settings, heard = self.settings, []
        weights = replace(self.learner.settings.weights, half=settings.half, far=settings.far)
        share = 0.1 + 0.9 * min(1.0, self._share_done(self.first_steps) / settings.ramp)

        def judge(motion: LocalMotion, trajectory: RootTrajectory) -> Tensor:
            rows = body_motion.show(motion, trajectory)
            if rows.shape[1] < settings.frames:
                return rows.new_zeros(())
            self._made.append(self._cut(rows.detach()))
            heard.append(body_motion.compute_generator_loss(self.critic(self._blur(rows))[0]))
            return settings.weight * share * heard[-1]

        parts = self.learner.compute_losses(weights, judge)
        heard_mean = torch.stack(heard).mean() if heard else torch.full((), math.nan)
        told = self._update(
            self.optimiser, self.learner.network, parts["loss"], {**parts, "generator": heard_mean.detach()}
        )
        with torch.no_grad():
            for mean, latest in zip(self.network.parameters(), self.learner.network.parameters(), strict=True):
                mean.lerp_(latest, 1 - settings.average)
        return told

    def _criticise(self) -> dict[str, float]:
        """One update of the critic on captured windows, fresh made ones and kept ones."""
        settings, fresh = self.settings, torch.cat(self._made)
        if self.history is None:
            size = self.group.share(settings.history)
            self.history = HistoryBuffer(fresh.repeat(-(-size // len(fresh)), 1, 1)[:size])
        with torch.no_grad():
            real = self._show_captured(self.learner.windows, self.group.share(settings.batch))
        made = self._blur(self.history.mix(fresh, self.generator))
        (for_real, one), (for_made, other) = self.critic(self._blur(real)), self.critic(made)
        loss = body_motion.compute_critic_loss(for_real, for_made)
        total = loss + settings.regularisation * (regularise_batch(one) + regularise_batch(other))
        if self.step % settings.penalised == 0:
            penalty = body_motion.compute_gradient_penalty(self.critic, real)
            total = total + settings.penalty * settings.penalised * penalty
        right = torch.cat([for_real.mean(dim=1) > 0, for_made.mean(dim=1) < 0]).float().mean()
        told = {"total": total, "critic": loss, "told": right}
        told = self._update(self.critic_optimiser, self.critic, total, told)
        return {name: told[name] for name in ("critic", "told")}

    def _update(
        self, optimiser: torch.optim.Optimizer, network: nn.Module, loss: Tensor, told: Mapping[str, Tensor]
    ) -> dict[str, float]:
        """One step by the loss, of which the first in `told` is the mean; all means over the processes."""
        if optimiser is self.optimiser:
            rate = self.settings.generator_rate * 0.5 * (1 + math.cos(math.pi * self._share_done(self.steps)))
            optimiser.param_groups[0]["lr"] = rate
        for each in (self.optimiser, self.critic_optimiser):
            each.zero_grad(set_to_none=True)
        means = self.differentiate(loss, network.parameters(), told)
        if not math.isfinite(first := next(iter(means.values()))):
            raise make_divergence_error(self.step + 1, f"the loss is {first}")
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        return means

    def _show_captured(self, windows: PoseWindows, batch: int) -> Float[Tensor, "batch frames rows"]:
        motion = windows.draw(batch, self.settings.frames + 2, self.generator)
        seen = LocalMotion.of_world(motion.world_poses()[0], motion.heading)
        # The way of captured motion is predicted too: else what is predicted would give made motion away.
        return body_motion.show(seen, self.learner.path(seen))

    def _cut(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, "batch cut rows"]:
        room = rows.shape[1] - self.settings.frames
        first = int(torch.randint(room + 1, (), generator=self.generator))
        return rows[:, first : first + self.settings.frames]

    def _blur(self, rows: Tensor) -> Tensor:
        return rows + self.settings.noise * torch.randn(rows.shape, generator=self.generator)

    @torch.no_grad()
    def _measure_critic(self, corpus: Corpus) -> Row:
        """Broken off or not, it changes nothing: the generator of random numbers is put back."""
        state = self.generator.get_state()
        self.generator.manual_seed(0)
        unseen = PoseWindows(corpus, kinds=self.learner.settings.kinds, evenness=1.0)
        scores = {
            name: float(self.critic(self._show_captured(windows, _JUDGED_CLIPS))[0].mean())
            for name, windows in (("training", self.learner.windows), ("unseen", unseen))
        }
        layout = replace(self.learner.settings.layout, shortest=float(_GAP), longest=float(_GAP), runs=0.0)
        moved, made = self._compare_weights(unseen, layout)
        self.generator.set_state(state)
        return {f"critic_{name}": score for name, score in scores.items()} | {"critic_made": made, "moved_cm": moved}

    def _compare_weights(self, windows: PoseWindows, layout: KeySettings) -> tuple[float, float]:
        """How far joints are apart between the weights before the critic and now, cm, and the critic's mean score."""
        frames = self.settings.frames + 2
        drawn = draw_windows(windows, _JUDGED_CLIPS, frames, layout, progress=1.0, tempo=0.0, generator=self.generator)
        image = make_key_image(drawn.motion, ToldParts.whole(drawn.known))
        style = torch.zeros(len(drawn.known), self.network.config.style)
        one, other = (network(image, style).turn_to_world(image) for network in (self.before, self.network))
        apart = 100 * (one.places - other.places).norm(dim=-1).mean(dim=-1)[~drawn.known].mean()
        heading = kinematics.heading_of_matrix(other.local_matrix[..., 0, :, :])
        seen = LocalMotion.of_world(other.places, heading)
        score = self.critic(body_motion.show(seen, self.learner.path(seen)))[0].mean()
        return float(apart), float(score)


@dataclass(frozen=True)
class CriticisedTweenerRecipe(TweenerRecipe):
    """What to train the generator on with a critic, and how; the best weights of all are what is exported."""

    guards = ("generator", "critic", "told")
    uses_gpu = False
    critic: CriticSettings = field(default_factory=CriticSettings)
    """When the critic joins, and how."""

    def make_trainer(self, parts: Split) -> Any:
        """As it is before the first step."""
        return CriticisedTrainer(super().make_trainer(parts), self.critic)

    def pin(self, trainer: Any, corpus: Corpus) -> dict[str, Row]:
        """What must not change between a run's parts."""
        return super().pin(trainer.learner, corpus) | {"critic": vars(self.critic)}

    def export(self, trainer: Any, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """What is written at the end: the best weights of all, and what they and the critic measured."""
        trainer.learner.network.load_state_dict(trainer.network.state_dict())
        done = super().export(trainer.learner, gathered, curve)
        return replace(done, quality={**done.quality, "validation": min(curve, key=self.score)})

    def find_stop_reason(self, trainer: Any, rows: Sequence[Row]) -> str | None:
        """Why to stop after these losses since the last line of news, if there is a reason."""
        if trainer.step <= self.critic.begin:
            return None
        where = f"step {trainer.step}"
        return find_winner(rows, losses=("generator", "critic"), least=self.report_steps, step=where)

    def score(self, row: Row) -> float:
        """Measure how far unseen gaps are from mocap: the error over interpolation's, and how far from 1 the ratios of
        speed, spread and jerk are (logarithms), the mean over kinds."""
        names = [name.removesuffix("_error_cm") for name in row if name.endswith("_error_cm")]
        kinds = [name for name in names if not name.startswith("before_")]
        return sum(_score_kind(row, kind) for kind in kinds) / max(1, len(kinds))

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        return f"{super().format_command()} --critic-from {self.critic.begin}"


def _score_kind(row: Row, kind: str) -> float:
    values = [row[f"{kind}_{name}"] for name in ("error_cm", "slerp_cm", "speed", "spread", "jerk")]
    if not all(value is not None and value > 0 for value in values):
        return math.inf
    error, slerp, *ratios = values
    return error / slerp + sum(abs(math.log(ratio)) for ratio in ratios)
