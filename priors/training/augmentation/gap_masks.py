"""Gaps as they are cut into training motions (Kaufmann et al. 2020, section 3.3).

Blocks of frames that grow in the course of training, joints that are lost throughout; and what the paper's masks lack:
keys far apart, poses known in part, joints dropped frame by frame.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.skeleton import CANONICAL
from priors.training.augmentation.draws import Draws

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
