"""Training of the LSTM-GMM: rnn paper, section 4.1.3, with departures kept as settings.

Windows of clips with noise on the inputs; loss is the negative log density of the next frame (Eq. 8). Everything random
comes from one generator whose state is in the checkpoint, so a resumed run continues bit for bit.
"""

import math
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import MapctlError, RequestError
from mapctl.features import LAYOUT, mirror_features
from priors.lstm_gmm import LstmGmm, LstmGmmConfig
from priors.training.corpus import Corpus, window_starts


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
    """Each window draws its noise level log-uniformly between `input_noise` and this many times it; 1 is the paper."""
    bit_flips: float = 0.02
    """Share of input contact bits that are flipped."""
    mirror: bool = True
    """Each window is mirrored left to right with probability one half."""
    weight_decay: float = 1e-4
    """Decoupled, for adam."""
    seed: int = 1
    """Of weights, windows and noise."""

    def __post_init__(self):
        for name in ("steps", "batch", "window"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name, known in (("optimiser", ("adam", "rmsprop")), ("schedule", ("cosine", "epochs"))):
            if getattr(self, name) not in known:
                raise RequestError(f"{name} must be {' or '.join(known)}, got {getattr(self, name)!r}")


PAPER = (
    LstmGmmConfig(width=500, components=5, retain=0.0),
    TrainingSettings(batch=20, window=50, optimiser="rmsprop", schedule="epochs", noise_range=1.0, bit_flips=0.0,
                     mirror=False, weight_decay=0.0, steps=30_000),
)  # fmt: skip
"""The variant as the paper prints it (30,000 iterations)."""


def statistics(features: Float[Tensor, "frames size"]) -> tuple[Tensor, Tensor]:
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


class Trainer:
    """Model, optimiser and generator, one step at a time."""

    def __init__(self, config: LstmGmmConfig, settings: TrainingSettings, corpus: Corpus, device: str = "cpu"):
        self.settings, self.device, self.step = settings, device, 0
        self.generator = torch.Generator().manual_seed(settings.seed)
        mean, std = statistics(corpus.features)
        with torch.random.fork_rng(devices=[]):  # torch draws weights from its global generator, which is the caller's
            torch.default_generator.manual_seed(settings.seed)
            self.model = LstmGmm(config, mean=mean, std=std).to(device)
        self.features = corpus.features
        self.starts = window_starts(corpus.lengths, settings.window + 1)
        self.optimiser = self._optimiser()

    def train_step(self) -> float:
        """One optimiser step; returns the loss in nats a frame. MapctlError, and no step, where that is no number."""
        settings = self.settings
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate()
        loss = -self._log_prob(self._windows()).mean()
        if not torch.isfinite(loss):
            raise _diverged(self.step + 1, f"the loss is {loss.item()} nats")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if settings.optimiser == "rmsprop":
            torch.nn.utils.clip_grad_value_(self.model.parameters(), settings.gradient_clip)
        else:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), settings.gradient_clip)
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
            raise _diverged(self.step, "its weights are not finite")

    def state(self) -> dict:
        """Everything a bit-exact continuation needs; tensors and plain numbers only."""
        return {"model": self.model.state_dict(), "optimiser": self.optimiser.state_dict(), "step": self.step,
                "generator": self.generator.get_state(), "settings": asdict(self.settings)}  # fmt: skip

    def load_state(self, state: dict) -> None:
        """Continue from what `state` gave."""
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.step = state["step"]

    def _optimiser(self) -> torch.optim.Optimizer:
        settings, parameters = self.settings, self.model.parameters()
        if settings.optimiser == "rmsprop":
            return torch.optim.RMSprop(parameters, lr=settings.learning_rate, alpha=0.9)
        return torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay)

    def _windows(self) -> Float[Tensor, "batch window_and_one size"]:
        settings = self.settings
        picked = torch.randint(len(self.starts), (settings.batch,), generator=self.generator)
        frames = self.starts[picked, None] + torch.arange(settings.window + 1)
        windows = self.features[frames]
        if settings.mirror:
            chosen = torch.rand(settings.batch, 1, 1, generator=self.generator) < 0.5
            windows = torch.where(chosen, mirror_features(windows), windows)
        return windows.to(self.device)

    def _log_prob(self, windows: Tensor) -> Tensor:
        """Log density of frames 1.. given noisy frames 0..: noise is on the inputs only (section 4.1.3)."""
        model, size = self.model, self.model.layout.continuous
        inputs = self._noisy(model.normalise(windows[:, :-1]), size)
        memory = model.initial_state(windows[:, 0])
        mixture, _ = model(inputs, (memory.hidden, memory.cell))
        target = torch.cat([model.normalise(windows[:, 1:])[..., :size], windows[:, 1:, size:]], dim=-1)
        return mixture.log_prob(target)

    def _noisy(self, inputs: Tensor, size: int) -> Tensor:
        settings, shape = self.settings, inputs.shape
        level = torch.rand(shape[0], 1, 1, generator=self.generator) * math.log(settings.noise_range)
        noise = torch.randn(shape[0], shape[1], size, generator=self.generator) * settings.input_noise * level.exp()
        flips = torch.rand(shape[0], shape[1], 2, generator=self.generator) < settings.bit_flips
        bits = torch.where(flips.to(inputs.device), -inputs[..., size:], inputs[..., size:])
        return torch.cat([inputs[..., :size] + noise.to(inputs.device), bits], dim=-1)


def _diverged(step: int, how: str) -> MapctlError:
    return MapctlError(f"training diverged at step {step}: {how}; the last checkpoint, if there is one, is kept")


def validation_nats(model: LstmGmm, corpus: Corpus, frames: int = 100) -> float:
    """Mean negative log density a frame over the first frames of every clip, clean inputs, from an empty memory."""
    total, count = 0.0, 0
    with torch.no_grad():
        for clip in corpus.clips():
            clip = clip[:frames].unsqueeze(0).to(model.mean.device)
            nats = -model.log_prob(clip[:, 1:], model.initial_state(clip[:, 0]))
            total, count = total + nats.sum().item(), count + nats.numel()
    return total / count
