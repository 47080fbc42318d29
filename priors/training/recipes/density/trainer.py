"""Training of the LSTM-GMM: Wang et al. 2019, section 4.1.3, with departures kept as settings.

Windows of clips with noise on the inputs; loss is the negative log density of the next frame (Eq. 8). Everything random
comes from one generator whose state is in the checkpoint, so a resumed run continues bit for bit.
"""

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
from priors.training.corpus import Corpus
from priors.training.feature_statistics import compute_feature_statistics
from priors.training.moment_matching import free_run_moment_loss
from priors.training.quality import density as density_quality
from priors.training.recipes.density.settings import TrainingSettings
from priors.training.trainer import GradientTrainer
from priors.training.windows import FeatureWindows

_KEEP_GROUP_PROBABILITY = 0.7
_LEAST_RUNS = 4  # free runs that are compared: slow ones with slow ones, by quarters


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
        self._latest = corpus.features[:0]  # windows of the step under way

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        return {"model": self.network}

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch, nats a frame."""
        self._latest, condition = self._draw_windows()
        return {"loss": -self._log_prob(self._latest, condition).mean()}

    def limit_gradients(self) -> None:
        """Clip, and add the gradient of free runs where it is time for it."""
        settings, matching = self.settings, self.settings.matching
        if settings.optimiser == "rmsprop":
            nn.utils.clip_grad_value_(self.network.parameters(), settings.gradient_clip)
        else:
            nn.utils.clip_grad_norm_(self.network.parameters(), settings.gradient_clip)
        # Of a run of unknown length the last part is its decay.
        is_late = self.decay is not None if self.steady else self.step >= matching.begin * self.first_steps
        if matching.begin < 1 and is_late and self.step % matching.every == 0:
            self._add_moment_gradient(self._latest)

    def compute_learning_rate(self) -> float:
        """At the current step."""
        settings = self.settings
        if settings.schedule == "epochs":
            passes = self.step * settings.batch * settings.window // max(1, len(self.windows.features))
            return settings.learning_rate * 0.95**passes
        warm = min(1.0, (self.step + 1) / 200)
        if self.steady:
            return warm * settings.learning_rate * self.find_fall()
        return warm * settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, self.step / self.steps)))

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """The recipe's own."""
        settings, parameters = self.settings, self.network.parameters()
        if settings.optimiser == "rmsprop":
            return {"optimiser": torch.optim.RMSprop(parameters, lr=settings.learning_rate, alpha=0.9)}
        decay = settings.weight_decay
        return {"optimiser": torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=decay)}

    def validate(self, corpus: Corpus) -> dict[str, float]:
        """Likelihood and the health of free runs: likelihood does not predict stability."""
        self.network.eval()
        row = {"validation_nats": density_quality.compute_validation_nats(self.network, corpus)}
        row |= density_quality.measure_free_runs(self.network, corpus)
        self.network.train()
        return row

    def _add_moment_gradient(self, windows: Tensor) -> None:
        """Add the gradient of the free runs' mismatch, clipped on its own: neither loss drowns the other."""
        parameters = [p for p in self.network.parameters() if p.requires_grad]
        before = [p.grad for p in parameters]
        for parameter in parameters:
            parameter.grad = None
        matching = self.settings.matching
        matching = replace(matching, batch=max(_LEAST_RUNS, self.group.share(matching.batch)))
        loss = free_run_moment_loss(self.network, windows, matching, self.generator, self.common)
        self.differentiate(loss, parameters, {})
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
        condition = torch.cat([level / NOISE_UNIT, told], -1) if model.config.knows_noise else told
        with torch.autocast(windows.device.type, torch.bfloat16, enabled=self.settings.bfloat16):
            mixture, _ = model(inputs, (memory.hidden, memory.cell), condition=condition)
        target = torch.cat([model.normalise(windows[:, 1:])[..., :size], windows[:, 1:, size:]], dim=-1)
        return mixture.log_prob(target, model.whitening)

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
