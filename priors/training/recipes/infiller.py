"""Training of the infiller: windows of which parts are hidden, and their distance from what it returns.

What is hidden is what is hidden from the pose transformer: beside the gaps and lost joints of Kaufmann et al. 2020,
section 3.3, keys far apart and poses known in part.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy
from tyro.conf import arg

from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.partial_motion import PartialMotion, interpolate_partial_motion
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.infiller import ConvInfiller, InfillerConfig, InfillerNetwork
from priors.training.data import Corpus, Split
from priors.training.gaps import InbetweenerTrainer
from priors.training.loop import Count, NetworkSettings
from priors.training.recipes.pose_transformer import sample_known_parts
from priors.training.windows import PoseWindows, draw_length

_SHORTEST_WINDOW = 16  # frames
_REST = [[0.0, 0.0, 0.0, 1.0]] * CANONICAL.num_joints
_ERROR_OFFSET_CM = 0.5  # cm that the guess may be off by before a window's weight falls
_MAX_ERROR_CM = 4.0  # cm beyond which it falls no more
_MIN_STD = 0.05  # metres: of a position that hardly moves, as the hips' over their own reference
_CHUNK_FRAMES = 50_000

# Weights beside that of the position error, cm, which is 1.
_PACE = 1.0  # of the joints' velocity error, cm a frame
_FEET = 0.05  # of the planted toes' error in velocity, cm a frame
_CONTACTS = 0.1  # of the contacts' cross entropy, nats


@dataclass(frozen=True, kw_only=True)
class InfillerSettings(NetworkSettings):
    """Train an infiller, which infill, tween, blend and chain begin with if it is named."""

    kind = "infiller"
    used_by = "use it with --method infiller --inbetweener"
    ours = InfillerConfig()
    shape_options = ("architecture",)
    least_window = _SHORTEST_WINDOW

    steps: Count = 8_000
    """Steps in all."""
    batch: Count = 6000
    """Frames a step; windows of one step are equally long."""
    window: Count = 160
    """Frames of the longest window; the shortest have 16, and as many are drawn of each octave."""
    architecture: Annotated[Literal["skips", "image"] | None, arg(metavar="skips|image")] = None
    """skips is ours, image that of Kaufmann et al. 2020."""

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
    them. Positions of hands and feet that are given in single frames are no part of an image."""
    known = replace(hidden.known, effectors=torch.zeros_like(hidden.known.effectors))
    shown = interpolate_partial_motion(replace(hidden, known=known), hidden.quats.new_tensor(_REST), 0.0)
    seen = known.positions
    seen[..., 0] &= known.world_rotations[..., 0]
    image = PositionImage.of_world(shown.world_poses()[0], shown.heading, motion.contacts, known=seen)
    return image, image.from_world(motion.world_poses()[0])


def compute_infiller_losses(
    network: InfillerNetwork, motion: PartialMotion, hidden: PartialMotion
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors that add up to it.

    L1 over the whole motion (Kaufmann et al. 2020, section 3.3), window by window divided by the number of coordinates
    that had to be filled: two joints that are lost count as much as a gap. A network that keeps what is known is so
    judged on what is not, an autoencoder on everything. A window in which the guess would do counts for more, or a
    network learns to fidget where a body stands still.
    """
    image, wanted = show_known(motion, hidden)
    proposed, lacking = network(image), ~image.known
    filled = lacking if network.keeps_observed else torch.ones_like(lacking)
    wrong = 100 * (proposed.positions - wanted)
    weight = _weigh_windows(image.positions, wanted, lacking) / (3 * filled.sum(dim=(1, 2)).clamp_min(1))
    miss = (weight * (wrong.abs().sum(-1) * filled).sum(dim=(1, 2))).mean()
    slip = torch.diff(wrong, dim=1)
    pace = (weight * slip.abs().sum(dim=(1, 2, 3))).mean()
    planted = motion.contacts[:, 1:] * motion.contacts[:, :-1]
    feet = (slip[..., list(TOE_JOINTS), :].abs().sum(-1) * planted).sum() / planted.sum().clamp_min(1)
    unsure = filled[..., list(TOE_JOINTS)]
    guessed = cross_entropy(proposed.contacts, motion.contacts, reduction="none")
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
