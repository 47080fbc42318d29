"""Training of the infiller: windows of motion with gaps cut into them, and their distance from what it returns.

Gaps are cut as by Kaufmann et al. 2020, section 3.3: blocks of frames that grow in the course of training, joints that
are lost throughout; and what the paper's masks lack: keys far apart, poses known in part, joints dropped frame by
frame.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy
from tyro.conf import arg

from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.checkpoints import require_at_least
from priors.infiller import InfillerConfig, InfillerNetwork
from priors.training.augment import Draws
from priors.training.data import Corpus, Split
from priors.training.loop import Count, GradientTrainer, NetworkSettings, Row, average_logarithms, make_generator
from priors.training.windows import PositionWindows, Window

VALIDATED_GAPS = (15, 30, 60)
"""Gaps that are validated, frames, where a window has room for them."""
_MARGIN_FRAMES = 8  # frames of a window that a gap must leave
_ERROR_OFFSET_CM = 0.5  # cm that the guess may be off by before a window's weight falls
_MAX_ERROR_CM = 4.0  # cm beyond which it falls no more
_MIN_STD = 0.05  # metres: of a position that hardly moves, as the hips' over their own reference
_JOINTS = CANONICAL.num_joints

# Weights beside that of the position error, cm, which is 1.
_PACE = 1.0  # of the joints' velocity error, cm a frame
_FEET = 0.05  # of the planted toes' error in velocity, cm a frame
_CONTACTS = 0.1  # of the contacts' cross entropy, nats
_EVENNESS = 0.5  # of windows among the data's top folders: 0 by their frames, 1 the same number from each

# A window has gaps, keys, or lost joints.
_KEYS = 0.15  # share of windows of which only single frames are known, now and then
_LOST = 0.4  # share of windows that lose joints (paper: half)
_SHORTEST = 5.0  # mean length of a gap when training begins, frames (paper: 10 at 60 fps)
_LONGEST = 60.0  # and when it has grown up (paper: 120 at 60 fps)
_GROWN = 0.5  # share of training after which the mean grows no more (paper: 60 of 200 epochs)
_SPREAD = 15.0  # standard deviation of the length, frames
_SEVERAL = 3  # gaps in a window, at most
_PARTIAL = 0.3  # share of windows with gaps, in which some joints stay known for some frames
_DROPOUT = 0.2  # share of windows with lost joints that drop them frame by frame, half of them at most


@dataclass(frozen=True, kw_only=True)
class InfillerSettings(NetworkSettings):
    """Train an infiller, which infill, tween, blend and chain begin with if it is named."""

    kind = "infiller"
    used_by = "use it with --method infiller --inbetweener"
    ours = InfillerConfig()
    shape_options = ("architecture",)

    steps: Count = 8_000
    """Steps in all."""
    window: Count = 160
    """Frames a window; shorter clips are taken whole."""
    architecture: Annotated[Literal["skips", "image"] | None, arg(metavar="skips|image")] = None
    """skips is ours, image that of Kaufmann et al. 2020."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 32, "window")

    def make_trainer(self, parts: Split) -> "InfillerTrainer":
        """Make the trainer as it is before the first step."""
        return InfillerTrainer(self, parts.train)


class InfillerTrainer(GradientTrainer[InfillerNetwork]):
    """Draws windows, cuts gaps into them, and brings the network nearer to filling them."""

    def __init__(self, settings: InfillerSettings, corpus: Corpus):
        self.windows = PositionWindows(corpus, frames=settings.window, evenness=_EVENNESS)
        self.config = settings.find_config()
        super().__init__(settings, lambda: InfillerNetwork(self.config, bfloat16=settings.bfloat16))
        mean, std = self.windows.moments()
        self.network.mean.copy_(mean)
        self.network.std.copy_(std.clamp_min(_MIN_STD))
        self.begin()

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        window = self.windows.draw(self.settings.batch, self.generator)
        known = sample_observation_mask(window.present, progress=self.step / self.steps, generator=self.generator)
        return compute_infiller_losses(self.network, window, known)

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the root-aligned joint error over a gap amid unseen windows, cm, beside that of the guess."""
        frames, row = self.settings.window, {}
        windows = PositionWindows(corpus, frames=frames, evenness=_EVENNESS)
        for gap in [gap for gap in VALIDATED_GAPS if gap + _MARGIN_FRAMES <= frames]:
            window = windows.draw(192, make_generator(gap))
            middle = (frames - gap) // 2
            known = window.present[..., None].expand(-1, -1, CANONICAL.num_joints).clone()
            known[:, middle : middle + gap] = False
            lacking, image = window.present[..., None] & ~known, window.image(known)
            wanted = image.from_world(window.positions)
            for name, positions in (("error", self.network(image).positions), ("guess", image.positions)):
                wrong = 100 * (positions - wanted)
                wrong = (wrong - wrong[..., :1, :]).norm(dim=-1) * lacking
                row[f"{name}_{gap}_cm"] = float(wrong.sum() / lacking.sum())
        return row

    def score(self, row: Row) -> float:
        """Return the error of gaps in unseen windows over that of the guess, geometric mean over their lengths."""
        gaps = [gap for gap in VALIDATED_GAPS if row.get(f"guess_{gap}_cm") and row.get(f"error_{gap}_cm")]
        return average_logarithms(row[f"error_{gap}_cm"] / row[f"guess_{gap}_cm"] for gap in gaps)


def compute_infiller_losses(network: InfillerNetwork, window: Window, known: Tensor) -> dict[str, Tensor]:
    """The loss, and in plain units the errors that add up to it.

    L1 over the whole motion (Kaufmann et al. 2020, section 3.3), window by window divided by the number of coordinates
    that had to be filled: two joints that are lost count as much as a gap. A network that keeps what is known is so
    judged on what is not, an autoencoder on everything. A window in which the guess would do counts for more, or a
    network learns to fidget where a body stands still.
    """
    image = window.image(known)
    wanted = image.from_world(window.positions)
    proposed = network(image)
    lacking = window.present[..., None] & ~known
    filled = lacking if network.keeps_observed else window.present[..., None].expand_as(known)
    wrong = 100 * (proposed.positions - wanted)
    weight = _weigh_windows(image.positions, wanted, lacking) / (3 * filled.sum(dim=(1, 2)).clamp_min(1))
    miss = (weight * (wrong.abs().sum(-1) * filled).sum(dim=(1, 2))).mean()
    pairs = window.present[:, 1:] & window.present[:, :-1]
    slip = torch.diff(wrong, dim=1) * pairs[..., None, None]
    pace = (weight * slip.abs().sum(dim=(1, 2, 3))).mean()
    planted = window.contacts[:, 1:] * window.contacts[:, :-1]
    feet = (slip[..., list(TOE_JOINTS), :].abs().sum(-1) * planted).sum() / planted.sum().clamp_min(1)
    unsure = filled[..., list(TOE_JOINTS)]
    guessed = cross_entropy(proposed.contacts, window.contacts, reduction="none")
    contacts = (guessed * unsure).sum() / unsure.sum().clamp_min(1)
    loss = miss + _PACE * pace + _FEET * feet + _CONTACTS * contacts
    error = ((wrong - wrong[..., :1, :]).norm(dim=-1).detach() * lacking).sum() / lacking.sum().clamp_min(1)
    return {
        "loss": loss,
        "position": miss,
        "pace": pace,
        "feet_cm_frame": feet,
        "contacts_nats": contacts,
        "error_cm": error,
    }


def _weigh_windows(guess: Tensor, wanted: Tensor, lacking: Tensor) -> Float[Tensor, " batch"]:
    """Weigh windows: the farther off the initial guess (mean over coordinates, cm), the less; 1 at 2 cm."""
    off = (100 * (guess - wanted).abs().mean(-1) * lacking).sum(dim=(1, 2)) / lacking.sum(dim=(1, 2)).clamp_min(1)
    return (2 + _ERROR_OFFSET_CM) / (off.clamp(max=_MAX_ERROR_CM) + _ERROR_OFFSET_CM)


def sample_observation_mask(
    present: Bool[Tensor, "batch frames"], *, progress: float, generator: torch.Generator
) -> Bool[Tensor, "batch frames joints"]:
    """Sample which positions of each window stay known; in every window some frame is known whole or in part."""
    draw = Draws(generator, *present.shape)
    length = _SHORTEST + (_LONGEST - _SHORTEST) * min(1.0, progress / _GROWN)
    kind = draw.uniform()
    frames = _sample_gaps(draw, length)
    partial = _sample_partial(draw) & (draw.uniform() < _PARTIAL)[:, None, None]
    gaps = frames[..., None] | partial
    keys = _sample_keyframes(draw, length)[..., None].expand_as(gaps)
    known = torch.where((kind < _KEYS)[:, None, None], keys, gaps)
    known = torch.where((kind > 1 - _LOST)[:, None, None], _sample_missing_joints(draw), known)
    known = known & present[..., None]
    # A window without anything known would teach the mean motion.
    lost = ~known.any(dim=2).any(dim=1)
    first = present & (present.long().cumsum(dim=1) == 1)
    return known | (lost[:, None] & first)[..., None]


def _sample_interval(draw: Draws, length: Float[Tensor, " batch"]) -> Bool[Tensor, "batch frames"]:
    """One run of so many frames, that may reach beyond the window's ends."""
    return draw.mark(draw.uniform() * (draw.frames + 8 - length).clamp_min(1) - 4, length)


def _sample_gaps(draw: Draws, length: float) -> Bool[Tensor, "batch frames"]:
    """True where a frame is known."""
    known = torch.ones(draw.batch, draw.frames, dtype=torch.bool)
    count = (1 + draw.uniform() * _SEVERAL).floor()
    for number in range(_SEVERAL):
        size = (length + _SPREAD * draw.normal()).clamp(2, draw.frames - 10)
        known &= ~(_sample_interval(draw, size / count.sqrt()) & (number < count)[:, None])
    return known


def _sample_keyframes(draw: Draws, length: float) -> Bool[Tensor, "batch frames"]:
    """Single frames, on average `length` apart, in half of the windows with the frame after it: a pose and its pace."""
    known = draw.uniform(draw.frames) < 1 / (2 + draw.uniform(1) * (2 * length))
    after = torch.cat([torch.zeros(draw.batch, 1, dtype=torch.bool), known[:, :-1]], dim=1)
    return known | (after & (draw.uniform(1) < 0.5))


def _sample_partial(draw: Draws) -> Bool[Tensor, "batch frames joints"]:
    """Some joints, or all but some, known for a stretch."""
    some = draw.joints(limbs=0.5)
    other = draw.uniform(1) < 0.25
    stretch = _sample_interval(draw, 1 + draw.uniform() ** 2 * draw.frames)
    return stretch[..., None] & torch.where(other, ~some, some)[:, None]


def _sample_missing_joints(draw: Draws) -> Bool[Tensor, "batch frames joints"]:
    """All known but 1 to 3 joints, or a limb, throughout or for a stretch; or any joint now and then."""
    lost = draw.joints(limbs=0.5)[:, None].expand(-1, draw.frames, -1)
    during = _sample_interval(draw, 10 + draw.uniform() * draw.frames) | (draw.uniform(1) < 0.7)
    dropped = draw.uniform(draw.frames, _JOINTS) < 0.5 * draw.uniform(1, 1)
    lost = torch.where((draw.uniform() < _DROPOUT)[:, None, None], dropped, lost & during[..., None])
    return ~lost
