"""Training of the infiller: windows of which parts are hidden, and their distance from what it returns.

What is hidden is what is hidden from the pose transformer: beside the gaps and lost joints of Kaufmann et al. 2020,
section 3.3, keys far apart and poses known in part.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.partial_motion import PartialMotion, interpolate_partial_motion
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL
from priors.infiller import ConvInfiller, InfillerConfig, InfillerNetwork
from priors.training.data import Corpus, Split
from priors.training.gaps import InbetweenerTrainer
from priors.training.loop import Count, NetworkSettings
from priors.training.recipes.pose_transformer import sample_known_parts
from priors.training.windows import PoseWindows, draw_length

_SHORTEST_WINDOW = 16  # frames
_REST = [[0.0, 0.0, 0.0, 1.0]] * CANONICAL.num_joints
_MIN_STD = 0.05  # metres: of a position that hardly moves, as the hips' over their own reference
_CHUNK_FRAMES = 50_000
_CONTACTS = 0.1  # weight of the contacts' cross entropy, nats; that of the position error, cm, is 1


@dataclass(frozen=True, kw_only=True)
class InfillerSettings(NetworkSettings):
    """Train an infiller, which infill, tween, blend and chain begin with if it is named."""

    kind = "infiller"
    used_by = "use it with --method infiller --inbetweener"
    ours = InfillerConfig()
    least_window = _SHORTEST_WINDOW

    steps: Count = 8_000
    """Steps in all."""
    batch: Count = 6000
    """Frames a step; windows of one step are equally long."""
    window: Count = 160
    """Frames of the longest window; the shortest have 16, and as many are drawn of each octave."""

    def make_trainer(self, parts: Split) -> "InfillerTrainer":
        return InfillerTrainer(self, parts.train)


class InfillerTrainer(InbetweenerTrainer[InfillerNetwork]):
    """Draws windows, hides parts of them, and brings the network nearer to filling them."""

    model, gaps = ConvInfiller, (15, 30, 60)

    def __init__(self, settings: InfillerSettings, corpus: Corpus):
        self.windows = PoseWindows(corpus)
        self.longest = min(settings.window, int(self.windows.lengths.max()))
        self.config = settings.find_config()
        super().__init__(settings, lambda: InfillerNetwork(self.config, bfloat16=settings.bfloat16))
        parts = corpus.features.split(_CHUNK_FRAMES)
        local = torch.cat([BodyPose.of_features_in_place(part).joints_world() for part in parts])
        local = torch.cat([local, mirror_positions(local)])
        self.network.mean.copy_(local.mean(dim=0))
        self.network.std.copy_(local.std(dim=0).clamp_min(_MIN_STD))
        self.begin()

    def losses(self) -> dict[str, Tensor]:
        frames = draw_length(_SHORTEST_WINDOW, self.longest, self.generator)
        motion = self.windows.draw(max(1, self.settings.batch // frames), frames, self.generator)
        return compute_infiller_losses(self.network, motion, sample_known_parts(motion, self.generator))


def show_known(
    motion: PartialMotion, hidden: PartialMotion
) -> tuple[PositionImage, Float[Tensor, "batch frames joints 3"]]:
    """Return the image of a motion of which parts are hidden, interpolated there, and the true positions as it has
    them."""
    shown = interpolate_partial_motion(hidden, hidden.quats.new_tensor(_REST), 0.0)
    seen = hidden.known.positions
    seen[..., 0] &= hidden.known.world_rotations[..., 0]
    image = PositionImage.of_world(shown.world_poses()[0], shown.heading, motion.contacts, known=seen)
    return image, image.from_world(motion.world_poses()[0])


def compute_infiller_losses(
    network: InfillerNetwork, motion: PartialMotion, hidden: PartialMotion
) -> dict[str, Tensor]:
    """Compute the loss, and in plain units the errors that add up to it: L1 over the whole motion (Kaufmann et al.
    2020, section 3.3)."""
    image, wanted = show_known(motion, hidden)
    proposed, lacking = network(image), ~image.known
    wrong = 100 * (proposed.positions - wanted)
    position, contacts = wrong.abs().mean(), cross_entropy(proposed.contacts, motion.contacts)
    error = ((wrong - wrong[..., :1, :]).norm(dim=-1).detach() * lacking).sum() / lacking.sum().clamp_min(1)
    loss = position + _CONTACTS * contacts
    return {"loss": loss, "position": position, "contacts_nats": contacts, "error_cm": error}
