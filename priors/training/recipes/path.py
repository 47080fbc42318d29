"""Training of the path predictor: windows of motion, and how far the predicted trajectory of the hips is from
their own (Zhou et al. 2020, section 3.4).
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.inbetweening.root_trajectory import (
    SPANS,
    LocalMotion,
    average_displacement_errors,
    compute_displacement_errors,
)
from priors.path import PathConfig, PathNetwork
from priors.training.data import Corpus, Split
from priors.training.loop import Count, GradientTrainer, NetworkSettings, Number, Row, geometric_mean, make_generator
from priors.training.windows import TEMPO, PoseVariation, PoseWindows

_VALIDATED = ("V1", "V8", "V32", "V64", "Y")
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
        self.windows = PoseWindows(corpus, evenness=1.0)
        # A window at the fastest tempo must fit into the longest clip.
        self.longest = min(settings.window, int(int(self.windows.lengths.max()) / (1 + TEMPO)) - 1)
        self.config = settings.find_config()
        super().__init__(settings, lambda: PathNetwork(self.config, bfloat16=settings.bfloat16))
        _set_moments(self.network, self.windows)
        self.begin()

    def losses(self) -> dict[str, Tensor]:
        spare = max(0, self.longest - _SHORTEST_WINDOW)
        frames = min(self.longest, _SHORTEST_WINDOW + int(torch.randint(spare + 1, (), generator=self.generator)))
        batch = max(1, self.settings.batch // frames)
        return compute_path_losses(self.network, self.windows.draw(batch, frames, self.generator, variation=_VARIATION))

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the mean error of displacements and heights over unseen clips, cm."""
        windows = PoseWindows(corpus, evenness=1.0)
        rows = [measure_clip(self.network, windows, number) for number in range(len(corpus.names))]
        found = {name: [row[name] for row in rows if name in row] for name in _VALIDATED}
        return {f"{name}_cm": sum(values) / len(values) for name, values in found.items() if values}

    def score(self, row: Row) -> float:
        """Return the errors over unseen clips, cm, geometric mean over spans and the height."""
        return geometric_mean(row.get(f"{name}_cm") for name in _VALIDATED)


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
            for span in SPANS
            if span < hips.shape[1]
        ]
    )
    height = 100 * (predicted.height - hips[..., 1]).abs().mean()
    contacts = cross_entropy(predicted.contacts, motion.contacts)
    loss = path.mean() + _HEIGHT * height + _CONTACTS * contacts
    parts = {"path_cm": path.mean(), "V1_cm": path[0], "height_cm": height, "contacts_nats": contacts}
    return {"loss": loss, **parts}


@torch.no_grad()
def measure_clip(network: PathNetwork, windows: PoseWindows, number: int) -> dict[str, float]:
    """Mean errors over a clip, cm: of displacements by their span, and of the height as `Y`."""
    clip, first = torch.tensor([number]), torch.zeros(1, dtype=torch.long)
    motion = windows.at(clip, first, int(windows.lengths[number]), torch.ones(1))
    predicted = network(LocalMotion.of_world(motion.world_poses()[0], motion.heading))
    trajectory, hips = predicted.integrate(motion.heading)[0], motion.root_position[0]
    height = 100 * float((trajectory[:, 1] - hips[:, 1]).abs().mean())
    return average_displacement_errors(trajectory[:, ::2], hips[:, ::2]) | {"Y": height}


def _set_moments(network: PathNetwork, windows: PoseWindows) -> None:
    """Set means and spreads of the positions that the network sees, of motion and its mirror image."""
    batch = windows.draw(4000, 4, make_generator(0))
    seen = LocalMotion.of_world(batch.world_poses()[0], batch.heading)
    positions = torch.cat([seen.positions, seen.mirrored().positions])[..., 1:, :].flatten(0, 1)
    network.mean.copy_(positions.mean(dim=0))
    network.std.copy_(positions.std(dim=0).clamp_min(_MIN_STD))
