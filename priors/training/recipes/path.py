"""Training of the path predictor: windows of motion, and how far the predicted trajectory of the hips is from
their own (Zhou et al. 2020, section 3.4).
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.inbetweening.root_trajectory import LocalMotion, compute_displacement_errors
from priors.path import PathConfig, PathNetwork
from priors.training.data import Corpus, Split
from priors.training.loop import (
    VALIDATED_BATCHES,
    Count,
    GradientTrainer,
    NetworkSettings,
    Number,
    Row,
    average_rows,
    make_generator,
)
from priors.training.windows import TEMPO, PoseVariation, PoseWindows

_SPANS = (1, 2, 4, 8, 16, 32, 64)  # frames after which displacements are compared: in time the paper's V2 to V128
_SHORTEST_WINDOW = 32  # frames
_MIN_STD = 0.05  # metres: of a position that hardly moves, as the thighs' from the hips
_HEIGHT = 1.0  # weight of the error of the hips' height, cm; that of the displacements, cm, is 1
_CONTACTS = 0.5  # weight of the contacts' cross entropy, nats
_VARIATION = PoseVariation(share=0.0, tilted=0.0)


@dataclass(frozen=True, kw_only=True)
class PathSettings(NetworkSettings):
    """Train a path predictor, which predicts the root trajectory from how the body moves about the hips."""

    kind = "path"
    used_by = "use it with mapctl infill --way A:B --path"
    ours = PathConfig()
    least_window = _SHORTEST_WINDOW

    steps: Count = 12_000
    """Steps in all."""
    batch: Count = 4096
    """Frames a step; windows of one step are equally long."""
    window: Count = 192
    """Frames of the longest window; the shortest have 32."""
    learning_rate: Number = 2e-3
    """At its highest; less to fine-tune."""

    def make_trainer(self, parts: Split) -> "PathTrainer":
        return PathTrainer(self, parts.train)


class PathTrainer(GradientTrainer[PathNetwork]):
    """Draws windows, and brings the trajectory that the network predicts of them nearer to their own."""

    def __init__(self, settings: PathSettings, corpus: Corpus):
        self.windows = PoseWindows(corpus)
        self.config = settings.find_config()
        super().__init__(settings, lambda: PathNetwork(self.config, bfloat16=settings.bfloat16))
        _set_moments(self.network, self.windows)
        self.begin()

    def losses(self) -> dict[str, Tensor]:
        return self._compare(self.windows, self.generator)

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> Row:
        """Measure the losses of unseen windows, drawn alike each time."""
        windows, generator = PoseWindows(corpus), make_generator(0)
        return average_rows([self._compare(windows, generator) for _ in range(VALIDATED_BATCHES)])

    def _compare(self, windows: PoseWindows, generator: torch.Generator) -> dict[str, Tensor]:
        # A window at the fastest tempo must fit into the longest clip.
        longest = min(self.settings.window, int(int(windows.lengths.max()) / (1 + TEMPO)) - 1)
        spare = max(0, longest - _SHORTEST_WINDOW)
        frames = min(longest, _SHORTEST_WINDOW + int(torch.randint(spare + 1, (), generator=generator)))
        batch = max(1, self.settings.batch // frames)
        return compute_path_losses(self.network, windows.draw(batch, frames, generator, variation=_VARIATION))


def compute_path_losses(network: PathNetwork, motion: PartialMotion) -> dict[str, Tensor]:
    """The loss, and in plain units the errors that add up to it.

    Displacements over 1, 2, 4 to 64 frames count alike (Zhou et al. 2020, Eq. 5), but by their distance instead of its
    square, which a few runs would fill. A step's error is then penalised by what it sums up to.
    """
    hips = motion.root_position
    predicted = network(LocalMotion.of_world(motion.world_poses()[0], motion.heading))
    ground = predicted.integrate(motion.heading)[..., ::2]
    path = torch.stack(
        [
            100 * compute_displacement_errors(ground, hips[..., ::2], span).mean()
            for span in _SPANS
            if span < hips.shape[1]
        ]
    )
    height = 100 * (predicted.height - hips[..., 1]).abs().mean()
    contacts = cross_entropy(predicted.contacts, motion.contacts)
    loss = path.mean() + _HEIGHT * height + _CONTACTS * contacts
    parts = {"path_cm": path.mean(), "V1_cm": path[0], "height_cm": height, "contacts_nats": contacts}
    return {"loss": loss, **parts}


def _set_moments(network: PathNetwork, windows: PoseWindows) -> None:
    """Set means and spreads of the positions that the network sees, of motion and its mirror image."""
    batch = windows.draw(4000, 4, make_generator(0))
    seen = LocalMotion.of_world(batch.world_poses()[0], batch.heading)
    positions = torch.cat([seen.positions, seen.mirrored().positions])[..., 1:, :].flatten(0, 1)
    network.mean.copy_(positions.mean(dim=0))
    network.std.copy_(positions.std(dim=0).clamp_min(_MIN_STD))
