"""Measures of an in-betweener in training: gaps in unseen clips, filled as commands fill them."""

import copy
from collections.abc import Iterable
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.pose import decode
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import MissingMask
from priors.checkpoints import Card, NetworkModel
from priors.training.data import Corpus, find_window_starts
from priors.training.loop import GradientTrainer, Network, Row, geometric_mean, use_device

_BESIDE = 10  # known frames on either side of a gap
_WINDOWS = 32  # gaps of one length, evenly over the clips


class InbetweenerTrainer(GradientTrainer[Network]):
    """A trainer whose network is ranked by the gaps that it fills in unseen clips."""

    model: ClassVar[type[NetworkModel[Any]]]
    """The in-betweener of the network."""
    gaps: tuple[int, ...]
    """Frames of the gaps."""

    def make_inbetweener(self, network: Network) -> Any:
        """Make the in-betweener of a network on the processor."""
        return self.model("in training", network, Card(self.settings.kind, {}, licence=""))

    def validate(self, corpus: Corpus) -> Row:
        """Measure gaps (see `measure_gaps`), on the processor."""
        with use_device("cpu"):
            network = copy.deepcopy(self.exported).to("cpu")
            return measure_gaps(self.make_inbetweener(network), corpus.to("cpu"), self.gaps)

    def score(self, row: Row) -> float:
        """Return the error of gaps as a share of the interpolation's, geometric mean over their lengths."""
        return geometric_mean(row.get(f"share_{gap}") for gap in self.gaps)


def measure_gaps(inbetweener: Inbetweener, corpus: Corpus, gaps: Iterable[int]) -> Row:
    """Measure gaps of so many frames amid clips: mean distance of joints from the truth, cm, and as a share of the
    interpolation's. Lengths for which no clip has room are left out."""
    row: Row = {}
    for gap in gaps:
        frames = gap + 2 * _BESIDE
        if frames <= max(corpus.lengths):
            starts = find_window_starts(corpus.lengths, frames)
            picked = starts[torch.linspace(0, len(starts) - 1, min(_WINDOWS, len(starts))).long()]
            errors = [_measure_gap(inbetweener, corpus.features[start : start + frames]) for start in picked.tolist()]
            own, interpolated = torch.stack(errors).mean(dim=0).tolist()
            row |= {f"error_{gap}_cm": 100 * own, f"share_{gap}": own / max(interpolated, 1e-6)}
    return row


def _measure_gap(inbetweener: Inbetweener, features: Float[Tensor, "frames size"]) -> Float[Tensor, "2"]:
    """Measure the mean distances, metres, of what is proposed and of the interpolation."""
    truth = decode(features.double(), GroundPose.origin(torch.float64))
    hidden = torch.zeros(len(features), dtype=torch.bool)
    hidden[_BESIDE:-_BESIDE] = True
    missing = MissingMask.of_frames(hidden, truth.num_joints)
    query = GapQuery(interpolate_missing(truth, missing), missing, torch.arange(len(features)) / PRIOR_FPS)
    proposed, wanted = inbetweener.propose(query).motion, truth.joint_positions()
    distances = [(motion.joint_positions() - wanted)[hidden].norm(dim=-1) for motion in (proposed, query.motion)]
    return torch.stack(distances).mean(dim=(1, 2))
