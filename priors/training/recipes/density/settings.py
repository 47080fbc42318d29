"""Settings by which an LSTM-GMM is trained: those of Wang et al. 2019, section 4.1.3, and departures from them."""

from dataclasses import dataclass, field

from mapctl.errors import RequestError
from priors.config import require_at_least
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training.augmentation.clip_copies import ClipCopies
from priors.training.moment_matching import MatchingSettings
from priors.training.recipes.density.critic import CriticSettings


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
    critic: CriticSettings = field(default_factory=CriticSettings)
    """Free runs judged by a critic."""
    untold: float = 0.5
    """Share of the windows without labels; the others show each group (gait, style) with probability 0.7."""
    bfloat16: bool = False
    """The network computes in bfloat16, weights and loss stay in float32: faster where the processor has it."""
    seed: int = 1
    """Seed of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch", "window")
        if self.critic.steps >= self.steps:
            raise RequestError(
                f"a critic joins the last steps of a run: {self.critic.steps} of them are not under the {self.steps} of"
                " all"
            )
        if self.critic.steps and self.window < self.critic.frames:
            raise RequestError(f"the critic sees {self.critic.frames} frames; windows have {self.window}")
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
