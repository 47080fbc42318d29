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

from mapctl import kinematics, rotations
from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.partial_motion import PartialMotion, interpolate_quats
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.numerics.intervals import fill_missing, fill_missing_angle
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.infiller import InfillerConfig, InfillerNetwork
from priors.training.augment import Draws
from priors.training.data import Corpus, Split
from priors.training.loop import Count, GradientTrainer, NetworkSettings, Row, geometric_mean, make_generator
from priors.training.windows import PaddedWindows

VALIDATED_GAPS = (15, 30, 60)
"""Gaps that are validated, frames, where a window has room for them."""
_MARGIN_FRAMES = 8  # frames of a window that a gap must leave
_ERROR_OFFSET_CM = 0.5  # cm that the guess may be off by before a window's weight falls
_MAX_ERROR_CM = 4.0  # cm beyond which it falls no more
_MIN_STD = 0.05  # metres: of a position that hardly moves, as the hips' over their own reference
_JOINTS = CANONICAL.num_joints
_CHUNK_FRAMES = 50_000

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
    least_window = 32

    steps: Count = 8_000
    """Steps in all."""
    window: Count = 160
    """Frames a window; shorter clips are taken whole."""
    architecture: Annotated[Literal["skips", "image"] | None, arg(metavar="skips|image")] = None
    """skips is ours, image that of Kaufmann et al. 2020."""

    def make_trainer(self, parts: Split) -> "InfillerTrainer":
        return InfillerTrainer(self, parts.train)


class InfillerTrainer(GradientTrainer[InfillerNetwork]):
    """Draws windows, cuts gaps into them, and brings the network nearer to filling them."""

    def __init__(self, settings: InfillerSettings, corpus: Corpus):
        self.windows = PaddedWindows(corpus, frames=settings.window, evenness=_EVENNESS)
        self.config = settings.find_config()
        super().__init__(settings, lambda: InfillerNetwork(self.config, bfloat16=settings.bfloat16))
        parts = corpus.features.split(_CHUNK_FRAMES)
        local = torch.cat([BodyPose.of_features_in_place(part).joints_world() for part in parts])
        local = torch.cat([local, mirror_positions(local)])
        self.network.mean.copy_(local.mean(dim=0))
        self.network.std.copy_(local.std(dim=0).clamp_min(_MIN_STD))
        self.begin()

    def losses(self) -> dict[str, Tensor]:
        motion, present = self.windows.draw(self.settings.batch, self.generator)
        known = sample_observation_mask(present, progress=self.step / self.steps, generator=self.generator)
        return compute_infiller_losses(self.network, motion, present, known)

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the root-aligned joint error over a gap amid unseen windows, cm, beside that of the guess."""
        frames, row = self.settings.window, {}
        windows = PaddedWindows(corpus, frames=frames, evenness=_EVENNESS)
        for gap in [gap for gap in VALIDATED_GAPS if gap + _MARGIN_FRAMES <= frames]:
            motion, present = windows.draw(192, make_generator(gap))
            middle = (frames - gap) // 2
            known = present[..., None].expand(-1, -1, _JOINTS).clone()
            known[:, middle : middle + gap] = False
            lacking, (image, wanted) = present[..., None] & ~known, show_known(motion, present, known)
            for name, positions in (("error", self.network(image).positions), ("guess", image.positions)):
                wrong = 100 * (positions - wanted)
                wrong = (wrong - wrong[..., :1, :]).norm(dim=-1) * lacking
                row[f"{name}_{gap}_cm"] = float(wrong.sum() / lacking.sum())
        return row

    def score(self, row: Row) -> float:
        """Return the error of gaps in unseen windows over that of the guess, geometric mean over their lengths."""
        gaps = [gap for gap in VALIDATED_GAPS if row.get(f"guess_{gap}_cm") and row.get(f"error_{gap}_cm")]
        return geometric_mean(row[f"error_{gap}_cm"] / row[f"guess_{gap}_cm"] for gap in gaps)


def interpolate_positions(
    positions_world: Float[Tensor, "batch frames joints 3"],
    local_quat_xyzw: Float[Tensor, "batch frames joints 4"],
    known: Bool[Tensor, "batch frames joints"],
) -> Float[Tensor, "batch frames joints 3"]:
    """Interpolate world positions, metres, on canonical bones; known ones as they are. Unknown values may be anything
    finite.

    A rotation is known while the joint and its children are.
    """
    shown = known.clone()
    for joint, parent in enumerate(CANONICAL.parents):
        if parent >= 0:
            shown[..., parent] &= known[..., joint]
    matrices = rotations.to_matrix(interpolate_quats(local_quat_xyzw, shown))
    root = fill_missing(positions_world[:, :, 0], known[..., 0])
    interpolated = kinematics.positions_from_matrices(CANONICAL, matrices) + root[:, :, None]
    return torch.where(known[..., None], positions_world, interpolated)


def show_known(
    motion: PartialMotion, present: Bool[Tensor, "batch frames"], known: Bool[Tensor, "batch frames joints"]
) -> tuple[PositionImage, Float[Tensor, "batch frames joints 3"]]:
    """Return the image of a motion with gaps, in which the guess is slerp's, and the true positions as it has them."""
    known, quats, positions = known & present[..., None], motion.quats.clone(), motion.world_poses()[0]
    quats[:, :, 0] = rotations.multiply(rotations.about_y(motion.heading), quats[:, :, 0])
    image = PositionImage.of_world(
        interpolate_positions(positions, quats, known),
        fill_missing_angle(motion.heading, known[..., 0]),
        motion.contacts,
        known=known,
        present=present,
    )
    return image, image.from_world(positions)


def compute_infiller_losses(
    network: InfillerNetwork, motion: PartialMotion, present: Bool[Tensor, "batch frames"], known: Tensor
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors that add up to it.

    L1 over the whole motion (Kaufmann et al. 2020, section 3.3), window by window divided by the number of coordinates
    that had to be filled: two joints that are lost count as much as a gap. A network that keeps what is known is so
    judged on what is not, an autoencoder on everything. A window in which the guess would do counts for more, or a
    network learns to fidget where a body stands still.
    """
    image, wanted = show_known(motion, present, known)
    proposed = network(image)
    lacking = present[..., None] & ~known
    filled = lacking if network.keeps_observed else present[..., None].expand_as(known)
    wrong = 100 * (proposed.positions - wanted)
    weight = _weigh_windows(image.positions, wanted, lacking) / (3 * filled.sum(dim=(1, 2)).clamp_min(1))
    miss = (weight * (wrong.abs().sum(-1) * filled).sum(dim=(1, 2))).mean()
    pairs = present[:, 1:] & present[:, :-1]
    slip = torch.diff(wrong, dim=1) * pairs[..., None, None]
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


def _sample_gaps(draw: Draws, length: float) -> Bool[Tensor, "batch frames"]:
    """True where a frame is known."""
    known = torch.ones(draw.batch, draw.frames, dtype=torch.bool)
    count = (1 + draw.uniform() * _SEVERAL).floor()
    for number in range(_SEVERAL):
        size = (length + _SPREAD * draw.normal()).clamp(2, draw.frames - 10)
        known &= ~(draw.stretch(size / count.sqrt()) & (number < count)[:, None])
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
    stretch = draw.stretch(1 + draw.uniform() ** 2 * draw.frames)
    return stretch[..., None] & torch.where(other, ~some, some)[:, None]


def _sample_missing_joints(draw: Draws) -> Bool[Tensor, "batch frames joints"]:
    """All known but 1 to 3 joints, or a limb, throughout or for a stretch; or any joint now and then."""
    lost = draw.joints(limbs=0.5)[:, None].expand(-1, draw.frames, -1)
    during = draw.stretch(10 + draw.uniform() * draw.frames) | (draw.uniform(1) < 0.7)
    dropped = draw.uniform(draw.frames, _JOINTS) < 0.5 * draw.uniform(1, 1)
    lost = torch.where((draw.uniform() < _DROPOUT)[:, None, None], dropped, lost & during[..., None])
    return ~lost
