"""Training of the LSTM-GMM: rnn paper, section 4.1.3, with departures kept as settings.

Windows of clips with noise on the inputs; loss is the negative log density of the next frame (Eq. 8). Everything random
comes from one generator whose state is in the checkpoint, so a resumed run continues bit for bit.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import MapctlError, RequestError
from mapctl.features import LAYOUT, mirror_features
from mapctl.problem import density_selection
from priors.config import require_at_least
from priors.lstm_gmm.labels import Labels
from priors.lstm_gmm.network import NOISE_UNIT, LstmGmm, LstmGmmConfig
from priors.training.corpus import Corpus, find_window_starts
from priors.training.moment_matching import MatchingSettings, free_run_moment_loss


@dataclass(frozen=True)
class TrainingSettings:
    """The recipe."""

    steps: int = 20_000
    """Optimiser steps in all."""
    batch: int = 128
    """Windows a step."""
    window: int = 50
    """Frames a window."""
    learning_rate: float = 1e-3
    """At the start."""
    optimiser: str = "adam"
    """`adam`, or the paper's `rmsprop`."""
    schedule: str = "cosine"
    """`cosine` to zero over all steps, or the paper's `epochs`: times 0.95 after each pass over the data."""
    gradient_clip: float = 5.0
    """`cosine` clips the gradient's norm to this, the paper's recipe each of its entries."""
    input_noise: float = 0.05
    """Standard deviation of the noise on normalised inputs (section 4.1.3)."""
    noise_range: float = 4.0
    """Each window draws its noise level log-uniformly between `input_noise` and this many times it; 1 is the paper.
    A network that knows the level is shown all levels down to none, low ones more often."""
    bit_flips: float = 0.02
    """Share of input contact bits that are flipped."""
    mirror: bool = True
    """Each window is mirrored left to right with probability one half."""
    weight_decay: float = 1e-4
    """Decoupled, for adam."""
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    """Free runs held to the data's moments."""
    untold: float = 0.5
    """Share of the windows of which no label is told; of the others each group (gait, style) is told with 0.7."""
    bfloat16: bool = False
    """The network computes in bfloat16, weights and loss stay in float32: faster where the processor has it."""
    seed: int = 1
    """Of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch", "window")
        for name, known in (("optimiser", ("adam", "rmsprop")), ("schedule", ("cosine", "epochs"))):
            if getattr(self, name) not in known:
                raise RequestError(f"{name} must be {' or '.join(known)}, got {getattr(self, name)!r}")


PAPER = (
    LstmGmmConfig(width=500, components=5, retain=0.0, correlated=False, knows_noise=False),
    TrainingSettings(
        batch=20,
        window=50,
        optimiser="rmsprop",
        schedule="epochs",
        noise_range=1.0,
        bit_flips=0.0,
        mirror=False,
        weight_decay=0.0,
        steps=30_000,
        matching=MatchingSettings(begin=1.0),
    ),
)
"""The variant as the paper prints it (30,000 iterations)."""


def compute_feature_statistics(features: Float[Tensor, "frames size"]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of features and their mirror image; floors keep held joints from exploding.

    Rotations are held to at least 0.01 rad (0.6 degrees), displacements to 1 mm; contact bits map to -1 and 1.
    """
    both = torch.cat([features, mirror_features(features)])
    mean, std = both.mean(0), both.std(0)
    floor = torch.full_like(std, 0.01)
    floor[LAYOUT.slices["root_displacement_heading"]] = 0.001
    floor[LAYOUT.slices["heading_change"]] = 0.002
    for values in (mean, floor, std):
        values[LAYOUT.slices["contacts"]] = 0.5
    return mean, torch.maximum(std, floor)


class DensityTrainer:
    """Model, optimiser and generator, one step at a time."""

    def __init__(
        self,
        config: LstmGmmConfig,
        settings: TrainingSettings,
        corpus: Corpus,
        device: str = "cpu",
        *,
        labels: Labels | None = None,
        init: Mapping[str, Tensor] | None = None,
    ):
        """`labels` of the corpus' clips, the network's own; `init` holds weights and statistics to begin with."""
        self.settings, self.device, self.step = settings, device, 0
        self.generator = torch.Generator().manual_seed(settings.seed)
        mean, std = compute_feature_statistics(corpus.features)
        with torch.random.fork_rng(devices=[]):  # torch draws weights from its global generator, which is the caller's
            torch.default_generator.manual_seed(settings.seed)
            self.model = LstmGmm(config, mean=mean, std=std).to(device)
        if init is not None:
            self.model.load_state_dict(dict(init))
        self.features, self.labels = corpus.features, labels or Labels.none(len(corpus.lengths))
        self.clip_ends = torch.tensor(corpus.lengths).cumsum(0)
        self.starts = find_window_starts(corpus.lengths, settings.window + 1)
        self.optimiser = self._make_optimiser()

    def train_step(self) -> float:
        """One optimiser step; returns the loss in nats a frame. MapctlError, and no step, where that is no number."""
        settings = self.settings
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate()
        windows, condition = self._sample_windows()
        loss = -self._log_prob(windows, condition).mean()
        if not torch.isfinite(loss):
            raise _make_divergence_error(self.step + 1, f"the loss is {loss.item()} nats")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if settings.optimiser == "rmsprop":
            torch.nn.utils.clip_grad_value_(self.model.parameters(), settings.gradient_clip)
        else:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), settings.gradient_clip)
        matching = settings.matching
        if self.step >= matching.begin * settings.steps and self.step % matching.every == 0:
            self._add_moment_gradient(windows)
        self.optimiser.step()
        self.step += 1
        return loss.item()

    def learning_rate(self) -> float:
        """At the current step."""
        settings = self.settings
        if settings.schedule == "epochs":
            passes = self.step * settings.batch * settings.window // max(1, len(self.features))
            return settings.learning_rate * 0.95**passes
        warm = min(1.0, (self.step + 1) / 200)
        return warm * settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, self.step / settings.steps)))

    def check_finite(self) -> None:
        """MapctlError unless every weight is a number."""
        if not all(bool(torch.isfinite(values).all()) for values in self.model.parameters()):
            raise _make_divergence_error(self.step, "its weights are not finite")

    def state(self) -> dict:
        """Everything a bit-exact continuation needs; tensors and plain numbers only."""
        return {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "generator": self.generator.get_state(),
            "settings": asdict(self.settings),
        }

    def load_state(self, state: dict) -> None:
        """Continue from what `state` gave."""
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.step = state["step"]

    def _make_optimiser(self) -> torch.optim.Optimizer:
        settings, parameters = self.settings, self.model.parameters()
        if settings.optimiser == "rmsprop":
            return torch.optim.RMSprop(parameters, lr=settings.learning_rate, alpha=0.9)
        return torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay)

    def _add_moment_gradient(self, windows: Tensor) -> None:
        """Add the gradient of the free runs' mismatch, clipped on its own: neither loss drowns the other."""
        parameters = [p for p in self.model.parameters() if p.requires_grad]
        loss = free_run_moment_loss(self.model, windows, self.settings.matching, self.generator)
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        found = [(p, g) for p, g in zip(parameters, gradients, strict=True) if g is not None]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(g) for _, g in found]))
        if not torch.isfinite(norm):
            return  # a free run that left the data's range says nothing
        for parameter, gradient in found:
            share = self.settings.gradient_clip / norm.clamp(min=self.settings.gradient_clip)
            parameter.grad = share * gradient if parameter.grad is None else parameter.grad + share * gradient

    def _sample_windows(self) -> tuple[Float[Tensor, "batch window_and_one size"], Float[Tensor, "batch labels"]]:
        """Windows of clips and the labels that are told of them."""
        settings = self.settings
        picked = torch.randint(len(self.starts), (settings.batch,), generator=self.generator)
        frames = self.starts[picked, None] + torch.arange(settings.window + 1)
        windows = self.features[frames]
        labels = self.labels.held[torch.searchsorted(self.clip_ends, frames[:, 0].contiguous(), right=True)]
        if settings.mirror:
            chosen = torch.rand(settings.batch, 1, 1, generator=self.generator) < 0.5
            windows = torch.where(chosen, mirror_features(windows), windows)
            labels = torch.where(chosen[:, :, 0], labels[:, self.labels.mirrored], labels)
        return windows.to(self.device), self._told(labels).to(self.device)

    def _told(self, labels: Float[Tensor, "batch labels"]) -> Float[Tensor, "batch labels"]:
        """Most often nothing is told, or one group only, so that the network does well with whatever it is told."""
        if not self.labels.names:
            return labels
        groups = self.labels.groups
        told = torch.rand(len(labels), len(groups), generator=self.generator) < _KEEP_GROUP_PROBABILITY
        told &= torch.rand(len(labels), 1, generator=self.generator) >= self.settings.untold
        return labels * (told.to(labels.dtype) @ groups)

    def _log_prob(self, windows: Tensor, told: Tensor) -> Tensor:
        """Log density of frames 1.. given noisy frames 0..: noise is on the inputs only (section 4.1.3)."""
        model, size = self.model, self.model.layout.continuous
        inputs, level = self._add_noise(model.normalise(windows[:, :-1]), size)
        memory = model.start_after(windows[:, 0])
        condition = torch.cat([level / NOISE_UNIT, told], -1) if model.config.knows_noise else told
        with torch.autocast(self.device, torch.bfloat16, enabled=self.settings.bfloat16):
            mixture, _ = model(inputs, (memory.hidden, memory.cell), condition=condition)
        target = torch.cat([model.normalise(windows[:, 1:])[..., :size], windows[:, 1:, size:]], dim=-1)
        return mixture.log_prob(target, model.whitening)

    def _add_noise(self, inputs: Tensor, size: int) -> tuple[Tensor, Float[Tensor, "batch 1"]]:
        """Inputs with noise and flipped bits, and each window's level of noise."""
        settings, shape = self.settings, inputs.shape
        share = torch.rand(shape[0], 1, 1, generator=self.generator)
        if self.model.config.knows_noise:
            level = settings.input_noise * settings.noise_range * share.square()
        else:
            level = settings.input_noise * torch.exp(share * math.log(settings.noise_range))
        noise = torch.randn(shape[0], shape[1], size, generator=self.generator) * level
        flips = torch.rand(shape[0], shape[1], 2, generator=self.generator) < settings.bit_flips
        bits = torch.where(flips.to(inputs.device), -inputs[..., size:], inputs[..., size:])
        noisy = torch.cat([inputs[..., :size] + noise.to(inputs.device), bits], dim=-1)
        return noisy, level[:, 0].to(inputs.device)


_KEEP_GROUP_PROBABILITY = 0.7


def _make_divergence_error(step: int, how: str) -> MapctlError:
    return MapctlError(f"training diverged at step {step}: {how}; the last checkpoint, if there is one, is kept")


def compute_validation_nats(model: LstmGmm, corpus: Corpus, frames: int = 100) -> float:
    """Mean negative log density a frame over the first frames of every clip, clean inputs, from an empty memory."""
    total, count = 0.0, 0
    with torch.no_grad():
        for clip in corpus.clips():
            clip = clip[:frames].unsqueeze(0).to(model.mean.device)
            nats = -model.log_prob(clip[:, 1:], model.start_after(clip[:, 0]))
            total, count = total + nats.sum().item(), count + nats.numel()
    return total / count


def compute_window_nats(model: LstmGmm, corpora: Iterable[Corpus]) -> dict[str, float]:
    """Log density a frame, physical units, of motion as wrong as a proposal is: mean over windows, and the value that
    98 % of them reach. By it a density's trust is told (see mapctl.problem.density_selection); clips begin with an
    empty memory.
    """
    blurred, found = model.cpu().with_observation_noise(density_selection.proposal_sigma()), []
    with torch.no_grad():
        for clip in (clip for corpus in corpora for clip in corpus.clips() if len(clip) > 1):
            nats = blurred.log_prob(clip[None, 1:], blurred.start_after(clip[:1]))[0]
            parts = density_selection.to_physical_log_density(nats, blurred.std).split(
                density_selection.SELECTION_WINDOW
            )
            found += [
                part.mean() for part in parts if len(part) == density_selection.SELECTION_WINDOW or len(parts) == 1
            ]
    values = torch.stack(found)
    return {"mean": float(values.mean()), "p2": float(values.quantile(0.02))}
