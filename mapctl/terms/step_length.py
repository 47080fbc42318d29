"""Step length: how far ahead of the other foot a foot comes down (the rnn paper's step-size knob, section 5.3)."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import TOES
from mapctl.terms.trial import Trial

TouchDown = tuple[int, int, int, int]


@dataclass(frozen=True)
class StepLength:
    """Where a toe touches down, it is a wanted distance from where the other one last stood.

    Touch-downs are the prior's own contact bits, as in footing; one whose partner last stood before the window is
    measured only if that was in the frame just before it.
    """

    length: float
    """Wanted, over the ground, metres."""
    sigma: float = 0.012
    """Of a step's length, metres: narrow, since only a few frames of a window are touch-downs."""
    name: str = "steps"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats, in the frames of touch-downs."""
        return 0.5 * (self._missed(trial) / self.sigma).square()

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """By how much the steps are too long or too short, metres; 0 between touch-downs."""
        return self._missed(trial).abs()

    def _missed(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        missed = torch.zeros_like(trial.features[..., 0])
        if not (touches := _find_touch_downs(trial)):
            return missed
        toes = trial.joints_world[..., trial.skeleton.indices(TOES), ::2]
        if len(trial.before):
            feet = trial.before[-1, trial.skeleton.indices(TOES), ::2].to(toes.dtype)
            toes = torch.cat([feet.expand(len(toes), 1, 2, 2), toes], dim=1)
        shift = int(len(trial.before) > 0)
        clip, frame, foot, stood = torch.tensor(touches).T
        apart = toes[clip, frame + shift, foot] - toes[clip, stood + shift, 1 - foot]
        lengths = torch.sqrt(apart.square().sum(-1) + 1e-12)
        return missed.index_put((clip, frame), lengths - self.length, accumulate=True)


def _find_touch_downs(trial: Trial) -> list[TouchDown]:
    """Clip, frame and foot of each touch-down, and the frame in which the other foot last stood; -1 is before."""
    bits = trial.contacts
    past = trial.contacts_before.to(bits.device).expand(len(bits), 2).unsqueeze(1)
    table = torch.cat([past, bits], dim=1).tolist()
    found = []
    for clip, rows in enumerate(table):
        last = [-1 if rows[0][foot] and len(trial.before) else None for foot in (0, 1)]
        for frame, (before, now) in enumerate(pairwise(rows)):
            last = [frame if now[foot] else last[foot] for foot in (0, 1)]
            touching = [foot for foot in (0, 1) if now[foot] and not before[foot]]
            found += [(clip, frame, foot, stood) for foot in touching if (stood := last[1 - foot]) is not None]
    return found
