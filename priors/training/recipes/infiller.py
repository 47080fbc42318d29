"""Training of the infiller: windows of motion with gaps cut into them, and how far from them it comes back.

Gaps as they are cut into training motions (Kaufmann et al. 2020, section 3.3).

Blocks of frames that grow in the course of training, joints that are lost throughout; and what the paper's masks lack:
keys far apart, poses known in part, joints dropped frame by frame.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.checkpoints import require_at_least
from priors.infiller import InfillerConfig, InfillerNetwork
from priors.training.augment import Draws
from priors.training.data import Corpus
from priors.training.loop import GradientTrainer, NetworkRecipe, Row, average_logarithms, make_generator
from priors.training.windows import PositionWindows, Window

_JOINTS = CANONICAL.num_joints


@dataclass(frozen=True)
class GapSettings:
    """What is cut out. A window has gaps, keys, or lost joints; shares of the three are these, gaps get the rest."""

    keys: float = 0.15
    """Share of windows of which only single frames are known, now and then."""
    joints: float = 0.4
    """Share of windows that lose joints (paper: half)."""
    shortest: float = 5.0
    """Mean length of a gap when training begins, frames (paper: 10 at 60 fps)."""
    longest: float = 60.0
    """And when it has grown up (paper: 120 at 60 fps)."""
    spread: float = 15.0
    """Standard deviation of the length, frames."""
    grown: float = 0.5
    """Share of training after which the mean grows no more (paper: 60 of 200 epochs)."""
    several: int = 3
    """Gaps in a window, at most."""
    partial: float = 0.3
    """Share of windows with gaps, in which some joints stay known for some frames."""
    dropout: float = 0.2
    """Share of windows with lost joints that drop them frame by frame, half of them at most."""

    def interpolate_mean_length(self, progress: float) -> float:
        """Return the mean length of a gap, frames, at a `progress` of training from 0 to 1."""
        return self.shortest + (self.longest - self.shortest) * min(1.0, progress / self.grown)


def sample_observation_mask(
    present: Bool[Tensor, "batch frames"], settings: GapSettings, *, progress: float, generator: torch.Generator
) -> Bool[Tensor, "batch frames joints"]:
    """Which places of each window stay known; in every window some frame is known whole or in part."""
    draw = Draws(generator, *present.shape)
    length = settings.interpolate_mean_length(progress)
    kind = draw.uniform()
    frames = _sample_gaps(draw, length, settings)
    partial = _sample_partial(draw, settings) & (draw.uniform() < settings.partial)[:, None, None]
    gaps = frames[..., None] | partial
    keys = _sample_keyframes(draw, length)[..., None].expand_as(gaps)
    known = torch.where((kind < settings.keys)[:, None, None], keys, gaps)
    known = torch.where((kind > 1 - settings.joints)[:, None, None], _sample_missing_joints(draw, settings), known)
    known = known & present[..., None]
    # A window without anything known would teach the mean motion.
    lost = ~known.any(dim=2).any(dim=1)
    first = present & (present.long().cumsum(dim=1) == 1)
    return known | (lost[:, None] & first)[..., None]


def _sample_interval(draw: Draws, length: Float[Tensor, " batch"]) -> Bool[Tensor, "batch frames"]:
    """One run of so many frames, that may reach beyond the window's ends."""
    return draw.mark(draw.uniform() * (draw.frames + 8 - length).clamp_min(1) - 4, length)


def _sample_gaps(draw: Draws, length: float, settings: GapSettings) -> Bool[Tensor, "batch frames"]:
    """True where a frame is known."""
    known = torch.ones(draw.batch, draw.frames, dtype=torch.bool)
    count = (1 + draw.uniform() * settings.several).floor()
    for number in range(settings.several):
        size = (length + settings.spread * draw.normal()).clamp(2, draw.frames - 10)
        known &= ~(_sample_interval(draw, size / count.sqrt()) & (number < count)[:, None])
    return known


def _sample_keyframes(draw: Draws, length: float) -> Bool[Tensor, "batch frames"]:
    """Single frames, on average `length` apart, in half of the windows with the frame after it: a pose and its pace."""
    known = draw.uniform(draw.frames) < 1 / (2 + draw.uniform(1) * (2 * length))
    after = torch.cat([torch.zeros(draw.batch, 1, dtype=torch.bool), known[:, :-1]], dim=1)
    return known | (after & (draw.uniform(1) < 0.5))


def _sample_partial(draw: Draws, settings: GapSettings) -> Bool[Tensor, "batch frames joints"]:
    """Some joints, or all but some, known for a stretch."""
    some = draw.joints(limbs=0.5)
    other = draw.uniform(1) < 0.25
    stretch = _sample_interval(draw, 1 + draw.uniform() ** 2 * draw.frames)
    return stretch[..., None] & torch.where(other, ~some, some)[:, None]


def _sample_missing_joints(draw: Draws, settings: GapSettings) -> Bool[Tensor, "batch frames joints"]:
    """All known but 1 to 3 joints, or a limb, throughout or for a stretch; or any joint now and then."""
    lost = draw.joints(limbs=0.5)[:, None].expand(-1, draw.frames, -1)
    during = _sample_interval(draw, 10 + draw.uniform() * draw.frames) | (draw.uniform(1) < 0.7)
    dropped = draw.uniform(draw.frames, _JOINTS) < 0.5 * draw.uniform(1, 1)
    lost = torch.where((draw.uniform() < settings.dropout)[:, None, None], dropped, lost & during[..., None])
    return ~lost


VALIDATED_GAPS = (15, 30, 60)
"""Gaps that are validated, frames, where a window has room for them."""
_MARGIN_FRAMES = 8  # frames of a window that a gap must leave
_ERROR_OFFSET_CM = 0.5  # cm that the guess may be off by before a window's weight falls
_MAX_ERROR_CM = 4.0  # cm beyond which it falls no more
_MIN_STD = 0.05  # metres: of a position that hardly moves, as the hips' over their own reference


@dataclass(frozen=True)
class InfillerSettings:
    """How an infiller is trained."""

    steps: int = 8_000
    """Updates."""
    batch: int = 64
    """Windows an update."""
    window: int = 160
    """Frames of each; shorter clips are taken whole."""
    learning_rate: float = 1e-3
    """At its highest; it falls to nothing along a cosine."""
    pace: float = 1.0
    """Weight of the joints' velocity error, cm a frame; that of the position error, cm, is 1."""
    feet: float = 0.05
    """Weight of the planted toes' error in velocity, cm a frame."""
    contacts: float = 0.1
    """Weight of the contacts' cross entropy, nats."""
    evenness: float = 0.5
    """How evenly windows are drawn from the data's top folders: 0 by their frames, 1 the same number from each."""
    gaps: GapSettings = field(default_factory=GapSettings)
    """What is cut out."""
    bfloat16: bool = False
    """The network computes in bfloat16; weights and loss stay in float32."""
    seed: int = 1
    """Seed of weights, windows and gaps."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch")
        if self.window < 32:
            raise RequestError(f"window must be at least 32 frames, got {self.window}")


class InfillerTrainer(GradientTrainer[InfillerNetwork]):
    """Draws windows, cuts gaps into them, and brings the network nearer to filling them."""

    def __init__(self, config: InfillerConfig, settings: InfillerSettings, corpus: Corpus):
        self.windows = PositionWindows(corpus, frames=settings.window, evenness=settings.evenness)
        super().__init__(lambda: InfillerNetwork(config, bfloat16=settings.bfloat16), settings)
        mean, std = self.windows.moments()
        self.network.mean.copy_(mean)
        self.network.std.copy_(std.clamp_min(_MIN_STD))

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        window, progress = self._draw(), self.step / self.steps
        gaps, generator = self.settings.gaps, self.generator
        known = sample_observation_mask(window.present, gaps, progress=progress, generator=generator)
        return compute_infiller_losses(self.network, window, known, self.settings)

    def _draw(self) -> Window:
        return self.windows.draw(self.settings.batch, self.generator)

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Root-aligned joint error over a gap in the middle of unseen windows, cm, beside that of the guess."""
        frames, row = self.settings.window, {}
        windows = PositionWindows(corpus, frames=frames, evenness=self.settings.evenness)
        for gap in [gap for gap in VALIDATED_GAPS if gap + _MARGIN_FRAMES <= frames]:
            window = windows.draw(192, make_generator(gap))
            middle = (frames - gap) // 2
            known = window.present[..., None].expand(-1, -1, CANONICAL.num_joints).clone()
            known[:, middle : middle + gap] = False
            lacking, image = window.present[..., None] & ~known, window.image(known)
            wanted = image.from_world(window.places)
            for name, places in (("error", self.network(image).places), ("guess", image.places)):
                wrong = 100 * (places - wanted)
                wrong = (wrong - wrong[..., :1, :]).norm(dim=-1) * lacking
                row[f"{name}_{gap}_cm"] = float(wrong.sum() / lacking.sum())
        return row


@dataclass(frozen=True)
class InfillerRecipe(NetworkRecipe[InfillerConfig, InfillerSettings, InfillerTrainer]):
    """What to train an infiller on, and how."""

    kind = "infiller"
    trainer_class = InfillerTrainer
    config: InfillerConfig = field(default_factory=InfillerConfig)
    settings: InfillerSettings = field(default_factory=InfillerSettings)

    def score(self, row: Row) -> float:
        """Error of gaps in unseen windows over that of the guess, geometric mean over their lengths."""
        gaps = [gap for gap in VALIDATED_GAPS if row.get(f"guess_{gap}_cm") and row.get(f"error_{gap}_cm")]
        return average_logarithms(row[f"error_{gap}_cm"] / row[f"guess_{gap}_cm"] for gap in gaps)


def compute_infiller_losses(
    network: InfillerNetwork, window: Window, known: Tensor, settings: InfillerSettings
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors it is made of.

    L1 over the whole motion (Kaufmann et al. 2020, section 3.3), window by window divided by the number of coordinates
    that had to be made: two joints that are lost count as much as a gap. A network that keeps what is known is so
    judged on what is not, an autoencoder on everything. A window in which the guess would do counts for more, or a
    network learns to fidget where nobody moves.
    """
    image = window.image(known)
    wanted = image.from_world(window.places)
    proposed = network(image)
    lacking = window.present[..., None] & ~known
    made = lacking if network.keeps_observed else window.present[..., None].expand_as(known)
    wrong = 100 * (proposed.places - wanted)
    weight = _weigh_windows(image.places, wanted, lacking) / (3 * made.sum(dim=(1, 2)).clamp_min(1))
    place = (weight * (wrong.abs().sum(-1) * made).sum(dim=(1, 2))).mean()
    pairs = window.present[:, 1:] & window.present[:, :-1]
    slip = torch.diff(wrong, dim=1) * pairs[..., None, None]
    pace = (weight * slip.abs().sum(dim=(1, 2, 3))).mean()
    planted = window.contacts[:, 1:] * window.contacts[:, :-1]
    feet = (slip[..., list(TOE_JOINTS), :].abs().sum(-1) * planted).sum() / planted.sum().clamp_min(1)
    unsure = made[..., list(TOE_JOINTS)]
    guessed = cross_entropy(proposed.contacts, window.contacts, reduction="none")
    contacts = (guessed * unsure).sum() / unsure.sum().clamp_min(1)
    loss = place + settings.pace * pace + settings.feet * feet + settings.contacts * contacts
    error = ((wrong - wrong[..., :1, :]).norm(dim=-1).detach() * lacking).sum() / lacking.sum().clamp_min(1)
    return {
        "loss": loss,
        "place": place,
        "pace": pace,
        "feet_cm_frame": feet,
        "contacts_nats": contacts,
        "error_cm": error,
    }


def _weigh_windows(guess: Tensor, wanted: Tensor, lacking: Tensor) -> Float[Tensor, " batch"]:
    """Weigh windows: the farther off the initial guess (mean over coordinates, cm), the less; 1 at 2 cm."""
    off = (100 * (guess - wanted).abs().mean(-1) * lacking).sum(dim=(1, 2)) / lacking.sum(dim=(1, 2)).clamp_min(1)
    return (2 + _ERROR_OFFSET_CM) / (off.clamp(max=_MAX_ERROR_CM) + _ERROR_OFFSET_CM)
