"""Training of the LSTM-GMM: Wang et al. 2019, section 4.1.3, with departures kept as settings.

Windows of clips with noise on the inputs; loss is the negative log density of the next frame (Eq. 8). Everything random
comes from one generator whose state is in the checkpoint, so a resumed run continues bit for bit.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from priors.config import require_at_least
from priors.lstm_gmm import density, labels
from priors.lstm_gmm.labels import Labels
from priors.lstm_gmm.network import NOISE_UNIT, LstmGmm, LstmGmmConfig
from priors.training.augmentation.clip_copies import ClipCopies, add_copies
from priors.training.corpus import Corpus, Split
from priors.training.devices import select_device
from priors.training.feature_statistics import compute_feature_statistics
from priors.training.gathering import DataSource, describe_selection
from priors.training.initial_states import measure_data_limits, select_initial_states
from priors.training.mocap.holdings import measure_holdings
from priors.training.moment_matching import MatchingSettings, free_run_moment_loss
from priors.training.parallel import count_launched
from priors.training.quality import density as density_quality
from priors.training.recipe import Export, Gathered, Recipe, Row, average, find_split_seed
from priors.training.trainer import GradientTrainer
from priors.training.windows import FeatureWindows


@dataclass(frozen=True)
class TrainingSettings:
    """How a density is trained."""

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
    copies: ClipCopies = field(default_factory=ClipCopies)
    """Copies of the clips at other tempos and with other strides, for corpora of a few minutes."""
    standing_share: float = 1.0
    """Share of the windows in which nobody goes anywhere that are drawn: where most of the motion stands, a density
    that sees all of them stands fast, and is hard to steer into a walk."""
    weight_decay: float = 1e-4
    """Decoupled, for adam."""
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    """Free runs held to the data's moments."""
    untold: float = 0.5
    """Share of the windows without labels; the others show each group (gait, style) with probability 0.7."""
    bfloat16: bool = False
    """The network computes in bfloat16, weights and loss stay in float32: faster where the processor has it."""
    seed: int = 1
    """Seed of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch", "window")
        if not 0 < self.standing_share <= 1:
            raise RequestError(f"the share of standing windows must be over 0 and at most 1: {self.standing_share:g}")
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

PLAIN = (
    LstmGmmConfig(components=1, correlated=False, knows_noise=False),
    TrainingSettings(noise_range=1.0, bit_flips=0.0, matching=MatchingSettings(begin=1.0)),
)
"""The plain peer: one Gaussian a frame whose values are independent, one level of noise, and likelihood alone."""


class DensityTrainer(GradientTrainer[LstmGmm]):
    """Draws windows, spoils the inputs, and makes the frames after them likelier."""

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
        self.settings, self.device = settings, device
        mean, std = compute_feature_statistics(corpus.features)
        super().__init__(
            lambda: LstmGmm(config, mean=mean, std=std).to(device),
            steps=settings.steps,
            learning_rate=settings.learning_rate,
            seed=settings.seed,
        )
        if init is not None:
            self.network.load_state_dict(dict(init))
        self.labels = labels or Labels.none(len(corpus.lengths))
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
        return drawn.features.to(self.device), self._tell_some(labels).to(self.device)

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
        with torch.autocast(self.device, torch.bfloat16, enabled=self.settings.bfloat16):
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
        bits = torch.where(flips.to(inputs.device), -inputs[..., size:], inputs[..., size:])
        noisy = torch.cat([inputs[..., :size] + noise.to(inputs.device), bits], dim=-1)
        return noisy, level[:, 0].to(inputs.device)


_KEEP_GROUP_PROBABILITY = 0.7
_LEAST_RUNS = 4  # free runs that are compared: slow ones with slow ones, by quarters


@dataclass(frozen=True)
class DensityRecipe(Recipe[LstmGmmConfig, TrainingSettings, DensityTrainer]):
    """What to train a density on, and how."""

    kind = "lstm-gmm"
    headline = "nats a frame"
    decay_cost = 1.4  # free runs are compared
    config: LstmGmmConfig = field(default_factory=LstmGmmConfig)
    """The network."""
    settings: TrainingSettings = field(default_factory=TrainingSettings)
    """How it is trained."""
    device: str = "auto"
    """`auto`, `cpu` or `cuda`."""
    starts: int = 64
    """Moments of mocap that the finished prior carries."""
    made: Path | None = None
    """Folder of clips that `mapctl make` made, which are trained on as well."""
    labels: str = ""
    """Regular expression whose named groups read labels from a clip's path, to condition the density on."""
    init: str | None = None
    """Prior whose weights and statistics training begins with; the network is then that prior's."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 1, "starts")

    def check(self) -> None:
        """Before anything is read."""
        device = select_device(self.device)
        if device == "cuda" and self.processes > 1 and count_launched() is None:
            raise RequestError(
                "several processes on GPUs are started by torchrun, one a GPU: python -m torch.distributed.run"
                f" --nproc-per-node {self.processes} -m mapctl train lstm-gmm ...; or use --device cpu"
            )
        super().check()

    def source(self) -> DataSource:
        """Where motion comes from."""
        return replace(super().source(), made=self.made)

    def make_trainer(self, parts: Split) -> DensityTrainer:
        """Make the trainer of a new network for the clips' labels, or of the initial network with its own labels."""
        corpus = add_copies(parts.train, self.settings.copies, torch.Generator().manual_seed(self.settings.seed))
        device, known = select_device(self.device), labels.read(corpus.names, self.labels)
        if self.init is None:
            config = replace(self.config, labels=known.names)
            return DensityTrainer(config, self.settings, corpus, device, labels=known)
        before = density.load(self.init).reference
        known = known.renamed(before.config.labels)
        return DensityTrainer(before.config, self.settings, corpus, device, labels=known, init=before.state_dict())

    def find_shape(self, trainer: DensityTrainer) -> LstmGmmConfig:
        """Return the configuration of the network that is trained."""
        return trainer.network.config

    def describe_data(self, corpus: Corpus) -> dict[str, str]:
        """What tells the data of this run from others'."""
        return corpus.identity() | {
            "match": self.match or "",
            "split seed": str(self.settings.seed if self.split is None else self.split),
            "labels": self.labels,
            "init": self.init or "",
        }

    def format_news(self, rows: Sequence[Row]) -> str:
        """One line on the losses of some steps."""
        return f"{average(rows, 'loss'):.2f} nats"

    @classmethod
    def find_headline(cls, row: Row) -> float:
        """Negative log density of unseen clips, nats a frame."""
        return _number(row.get("validation_nats"))

    @classmethod
    def find_card_headline(cls, quality: Row) -> float:
        """Find it in the quality that a card tells."""
        return _number(quality.get("test_nats_per_frame"))

    @classmethod
    def as_log_error(cls, value: float) -> float:
        """Nats by the numbers of a frame: the logarithm of how far each is off, up to a constant."""
        return value / LAYOUT.continuous

    @property
    def split_seed(self) -> int:
        """That of the initial weights, where there are any."""
        return find_split_seed(self.init, super().split_seed)

    def export(self, trainer: DensityTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """The network with moments to start from, and what the data show to be possible."""
        model, corpus, parts = trainer.network.cpu().eval(), gathered.corpus, gathered.parts
        known, seeded = labels.read(parts.train.names, self.labels), torch.Generator().manual_seed(self.settings.seed)
        found = select_initial_states(model, parts.train, count=self.starts, generator=seeded, labels=known.held)
        data = {
            "clips": len(corpus.names),
            "frames": len(corpus.features),
            **describe_selection(corpus),
            "holds": measure_holdings(corpus),
            "match": self.match or "",
            "labels": self.labels,
            "split_seed": self.split_seed,
            "starts": list(found.names),
            "held_out": gathered.held_out(),
        }
        return Export(
            {
                **model.state_dict(),
                "starts.previous": found.state.last_frame,
                "starts.hidden": found.state.hidden,
                "starts.cell": found.state.cell,
                "starts.speed": found.speed,
                "starts.weight": found.weight,
            },
            data,
            density_quality.measure_quality(model, parts),
            asdict(measure_data_limits(parts.train)),
        )

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        option, config, settings = self._find_variant()
        parts = [f"mapctl train lstm-gmm --data DATA -o RUN --match '{self.match or ''}'"]
        parts += [f"--labels '{self.labels}'"] if self.labels else []
        parts += [f"--init {self.init}"] if self.init else [f"--width {self.config.width}"]
        mixed = self.init is None and self.config.components != config.components
        parts += [f"--components {self.config.components}"] if mixed else []
        parts += ["--made MADE"] if self.made else []
        parts += self.format_reading() + ["--bfloat16"] * self.settings.bfloat16
        parts += self.format_changed(settings, "steps", "batch", "window", "learning_rate", "standing_share", "seed")
        parts += self.settings.copies.format_options()
        parts += self.format_processes() + self.format_ending()
        return " ".join(parts + option)

    def _find_variant(self) -> tuple[list[str], LstmGmmConfig, TrainingSettings]:
        """The option of the variant that this is one of, and what the command takes with it alone."""
        for option, (config, settings) in (("--paper", PAPER), ("--plain", PLAIN)):
            shape = {"width": self.config.width, "components": self.config.components, "labels": self.config.labels}
            if self.init is None and replace(config, **shape) == self.config:
                return [option], config, settings
        return [], LstmGmmConfig(), TrainingSettings()


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
