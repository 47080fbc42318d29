"""Training of the LSTM-GMM: Wang et al. 2019, section 4.1.3, with departures kept as settings.

Windows of clips with noise on the inputs; loss is the negative log density of the next frame (Eq. 8). Everything random
comes from one generator whose state is in the checkpoint, so a resumed run continues bit for bit.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import one_hot

from priors.lstm_gmm.labels import Labels
from priors.lstm_gmm.network import NOISE_UNIT, LstmGmm, LstmGmmConfig
from priors.lstm_gmm.paces import PACE_LABELS
from priors.training.adversaries.history import HistoryBuffer
from priors.training.corpus import Corpus
from priors.training.feature_statistics import compute_feature_statistics
from priors.training.moment_matching import moment_loss, run_free
from priors.training.parallel import TrainingGroup
from priors.training.quality import density as density_quality
from priors.training.recipes.density.critic import FreeRunJudge
from priors.training.recipes.density.settings import TrainingSettings
from priors.training.trainer import GradientTrainer
from priors.training.windows import FeatureWindows

_KEEP_GROUP_PROBABILITY = 0.7
_LEAST_RUNS = 4  # free runs that are compared: slow ones with slow ones, by quarters
_UNTOLD = {"critic": 2 * math.log(2), "told": 0.5}  # of a critic that knows nothing


class DensityTrainer(GradientTrainer[LstmGmm]):
    """Draws windows, spoils the inputs, and makes the frames after them likelier."""

    def __init__(
        self,
        config: LstmGmmConfig,
        settings: TrainingSettings,
        corpus: Corpus,
        *,
        labels: Labels | None = None,
        paces: Int[Tensor, " frames"] | None = None,
        init: Mapping[str, Tensor] | None = None,
    ):
        """`labels` of the corpus' clips, the network's own, with those of PACE_LABELS held by none; `paces` of its
        frames, as `follow_paces` finds them, if these are told; `init` holds weights and statistics to begin with."""
        self.settings = settings
        mean, std = compute_feature_statistics(corpus.features)
        super().__init__(
            lambda: LstmGmm(config, mean=mean, std=std),
            steps=settings.steps,
            learning_rate=settings.learning_rate,
            seed=settings.seed,
        )
        if init is not None:
            self.network.load_state_dict(dict(init))
        self.labels = labels or Labels.none(len(corpus.lengths))
        self.paces = paces
        self._pace_labels = [] if paces is None else [self.labels.names.index(name) for name in PACE_LABELS]
        self.clip_ends = torch.tensor(corpus.lengths).cumsum(0)
        self.windows = FeatureWindows(corpus, settings.window + 1, standing_share=settings.standing_share)
        self._latest = corpus.features[:0], self.labels.held[:0]  # windows of the step under way, and their labels
        self.judge: FreeRunJudge | None = None
        self.average = self.network
        """Moving average of the weights since the critic joined, the weights themselves without one: what is measured
        and exported."""
        if settings.critic.steps:
            self.judge = FreeRunJudge(settings.critic, self.windows, mirror=settings.mirror, seed=settings.seed)
            self.average = copy.deepcopy(self.network).requires_grad_(False)

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        critic = {} if self.judge is None else {"average": self.average, "critic": self.judge.network}
        return {"model": self.network, **critic}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """One for each of the two that contend."""
        return super().optimisers() | ({} if self.judge is None else {"critic-optimiser": self.judge.optimiser})

    def join(self, group: TrainingGroup) -> None:
        """Train as one of a group from here on, each with its part of what the critic has been shown."""
        super().join(group)
        if self.judge is not None and self.judge.history is not None:
            self.judge.history = self.judge.history.split(group)

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs, but the step."""
        if self.judge is None or self.judge.history is None:
            return super().state()
        return super().state() | {"history": self.group.gather(self.judge.history.windows)}

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` gave; KeyError or RuntimeError where it is not whole."""
        super().load_state(tensors, step)
        if self.judge is not None and "history" in tensors:
            self.judge.history = HistoryBuffer(tensors["history"].to(self.windows.features.device))

    def train_step(self) -> dict[str, float]:
        """One update, and those of the critic where it has joined; `critic` is its loss, 1.39 where it knows nothing,
        `told` the share of windows that it tells from mocap."""
        if self.judge is not None and self._criticised == 0:
            self._introduce(self.judge)
        parts = super().train_step()
        if self.judge is None:
            return parts
        if self.judge.history is None:
            self.average.load_state_dict(self.network.state_dict())
            return {**parts, **_UNTOLD}
        parts |= self.judge.learn(self, self.settings.critic.updates)
        keep = min(self.settings.critic.average, self._criticised / (self._criticised + 20))
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, 1 - keep)
        return parts

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch, nats a frame."""
        self._latest = self._draw_windows()
        return {"loss": -self._log_prob(*self._latest).mean()}

    def limit_gradients(self) -> None:
        """Clip, and add the gradient of free runs where it is time for it."""
        settings, matching = self.settings, self.settings.matching
        if settings.optimiser == "rmsprop":
            nn.utils.clip_grad_value_(self.network.parameters(), settings.gradient_clip)
        else:
            nn.utils.clip_grad_norm_(self.network.parameters(), settings.gradient_clip)
        if self._joined is not None:
            if self._criticised % settings.critic.every == 0:
                self._add_free_run_gradients(*self._latest)
            return
        # Of a run of unknown length the last part is its decay.
        begin = matching.begin * (self.first_steps - settings.critic.steps)
        is_late = self.decay is not None if self.steady else self.step >= begin
        if matching.begin < 1 and is_late and self.step % matching.every == 0:
            self._add_free_run_gradients(*self._latest)

    def compute_learning_rate(self) -> float:
        """At the current step."""
        settings = self.settings
        if settings.schedule == "epochs":
            passes = self.step * settings.batch * settings.window // max(1, len(self.windows.features))
            return settings.learning_rate * 0.95**passes
        if self._joined is not None:
            with_critic = self.steps - self.first_steps + settings.critic.steps
            return settings.critic.compute_learning_rate(self._criticised, with_critic)
        warm = min(1.0, (self.step + 1) / 200)
        if self.steady:
            return warm * settings.learning_rate * self.find_fall()
        steps = self.steps - settings.critic.steps
        return warm * settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, self.step / steps)))

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """The recipe's own."""
        settings, parameters = self.settings, self.network.parameters()
        if settings.optimiser == "rmsprop":
            return {"optimiser": torch.optim.RMSprop(parameters, lr=settings.learning_rate, alpha=0.9)}
        decay = settings.weight_decay
        return {"optimiser": torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=decay)}

    def validate(self, corpus: Corpus) -> dict[str, float]:
        """Likelihood and the health of free runs: likelihood does not predict stability."""
        self.average.eval()
        row = {"validation_nats": density_quality.compute_validation_nats(self.average, corpus)}
        row |= density_quality.measure_free_runs(self.average, corpus)
        self.average.train()
        return row

    @property
    def _criticised(self) -> int:
        """Steps since the critic joined; below 0 before."""
        return self.step - self.first_steps + self.settings.critic.steps

    @property
    def _joined(self) -> FreeRunJudge | None:
        """The critic, once it has joined."""
        return self.judge if self._criticised >= 0 else None

    @torch.no_grad()
    def _introduce(self, judge: FreeRunJudge) -> None:
        """Show the critic what the density makes, and let it learn, before the density hears it."""
        settings = self.settings.critic
        self.average.load_state_dict(self.network.state_dict())
        made, count = [], self.group.share(settings.history)
        while sum(map(len, made)) < count:
            made.append(self._run_free(*self._draw_windows())[0])
        judge.fill(torch.cat(made)[:count])
        with torch.enable_grad():
            judge.learn(self, settings.head_start)

    def _run_free(self, windows: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
        """Free runs after the first windows, told their paces as the network is in this step, and how these go on.

        A pace may change within a window. Gait and style last, and runs have them from the frames they begin with: told
        them as well, a density of walks was no better.
        """
        matching = self.settings.matching
        matching = replace(matching, batch=max(_LEAST_RUNS, self.group.share(matching.batch)))
        least = self.settings.critic.frames if self.judge is not None else 0
        paces = torch.zeros_like(told)
        paces[:, self._pace_labels] = told[:, self._pace_labels]
        condition = self._make_condition(told.new_zeros(len(told), 1), paces)
        return run_free(self.network, windows, matching, self.generator, self.common, least=least, condition=condition)

    def _add_free_run_gradients(self, windows: Tensor, told: Tensor) -> None:
        """Add the gradient of the free runs' mismatch, and that of what the critic says of them where it has joined,
        each clipped on its own: no loss drowns another."""
        judge, (made, real) = self._joined, self._run_free(windows, told)
        if self.settings.matching.begin < 1:
            moments = moment_loss(made[:, : real.shape[1]], real, self.settings.matching)
            self._add_gradient(moments, retain_graph=judge is not None)
        if judge is not None:
            self._add_gradient(judge.hear(made, self.generator))

    def _add_gradient(self, loss: Tensor, *, retain_graph: bool = False) -> None:
        parameters = [p for p in self.network.parameters() if p.requires_grad]
        before = [p.grad for p in parameters]
        for parameter in parameters:
            parameter.grad = None
        self.differentiate(loss, parameters, {}, retain_graph=retain_graph)
        found = [p.grad for p in parameters]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(g) for g in found if g is not None]))
        share = self.settings.gradient_clip / norm.clamp(min=self.settings.gradient_clip)
        # A free run that left the data's range says nothing.
        share = share if bool(torch.isfinite(norm)) else None
        for parameter, gradient, own in zip(parameters, found, before, strict=True):
            parameter.grad = own
            if gradient is not None and share is not None:
                parameter.grad = share * gradient if own is None else own + share * gradient

    def _draw_windows(self) -> tuple[Float[Tensor, "batch window_and_one size"], Float[Tensor, "batch labels"]]:
        """Windows of clips with the labels that the network is shown."""
        drawn = self.windows.draw(self.group.share(self.settings.batch), self.generator, mirror=self.settings.mirror)
        labels = self.labels.held[torch.searchsorted(self.clip_ends, drawn.first, right=True)]
        labels = torch.where(drawn.mirrored[:, None], labels[:, self.labels.mirrored], labels)
        if self.paces is not None:
            # How a window ends: told a pace that is not yet its own, the network changes to it within a window.
            ends = self.paces[drawn.first + self.settings.window]
            labels[:, self._pace_labels] = one_hot(ends, len(PACE_LABELS)).to(labels.dtype)
        return drawn.features, self._tell_some(labels)

    def _tell_some(self, labels: Float[Tensor, "batch labels"]) -> Float[Tensor, "batch labels"]:
        """Mostly show no label or one group only, so that the network works with any subset of labels."""
        if not self.labels.names:
            return labels
        groups = self.labels.groups
        told = torch.rand(len(labels), len(groups), generator=self.generator) < _KEEP_GROUP_PROBABILITY
        told &= torch.rand(len(labels), 1, generator=self.generator) >= self.settings.untold
        return labels * (told.to(labels.dtype) @ groups)

    def _log_prob(self, windows: Tensor, told: Tensor) -> Tensor:
        """Log density of frames 1.. given noisy frames 0..: noise is on the inputs only (section 4.1.3)."""
        model, size = self.network, self.network.layout.continuous
        inputs, level = self._add_noise(model.normalise(windows[:, :-1]), size)
        memory = model.start_after(windows[:, 0])
        condition = self._make_condition(level, told)
        with torch.autocast(windows.device.type, torch.bfloat16, enabled=self.settings.bfloat16):
            mixture, _ = model(inputs, (memory.hidden, memory.cell), condition=condition)
        target = torch.cat([model.normalise(windows[:, 1:])[..., :size], windows[:, 1:, size:]], dim=-1)
        return mixture.log_prob(target, model.whitening)

    def _make_condition(self, level: Float[Tensor, "batch 1"], told: Tensor) -> Float[Tensor, "batch conditions"]:
        """Make what the network is told: the level of its input's noise where it wants to know it, and labels."""
        return torch.cat([level / NOISE_UNIT, told], -1) if self.network.config.knows_noise else told

    def _add_noise(self, inputs: Tensor, size: int) -> tuple[Tensor, Float[Tensor, "batch 1"]]:
        """Inputs with noise and flipped bits, and each window's level of noise."""
        settings, shape = self.settings, inputs.shape
        share = torch.rand(shape[0], 1, 1, generator=self.generator)
        if self.network.config.knows_noise:
            level = settings.input_noise * settings.noise_range * share.square()
        else:
            level = settings.input_noise * torch.exp(share * math.log(settings.noise_range))
        noise = torch.randn(shape[0], shape[1], size, generator=self.generator) * level
        flips = torch.rand(shape[0], shape[1], 2, generator=self.generator) < settings.bit_flips
        bits = torch.where(flips, -inputs[..., size:], inputs[..., size:])
        noisy = torch.cat([inputs[..., :size] + noise, bits], dim=-1)
        return noisy, level[:, 0]
