"""Training of the denoiser: windows of clean motion, corrupted anew each time, and what it returns."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import rotations
from mapctl.features import LAYOUT
from mapctl.pose import BodyPose
from mapctl.recording import CaptureProposal
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.denoiser import DenoiserConfig, DenoiserNetwork
from priors.training.augment import corrupt, make_clean_capture
from priors.training.data import Corpus, Split
from priors.training.loop import (
    VALIDATED_BATCHES,
    Count,
    GradientTrainer,
    MaybeCount,
    NetworkSettings,
    Row,
    average_rows,
    make_generator,
)
from priors.training.windows import FeatureWindows, PoseVariation, measure_lengths, vary_features

# Weights beside that of the position error, cm, which is 1.
_ANGLES = 20.0  # of the error of joint angles, radians: what turns about its own bone moves no joint
_PACE = 0.5  # of the joints' velocity error, cm a frame
_FEET = 0.5  # of the planted toes' error in velocity, cm a frame
_CONTACTS = 0.5  # of the contacts' cross entropy, nats
_SPREAD = 0.1  # of the negative log-likelihood of the errors, which only the spread's own layer learns from
_EVENNESS = 0.5  # of windows among the data's top folders: 0 by their frames, 1 the same number from each
_CALIBRATION_DEG = 5.0  # spread of a rig's joint frames about the canonical ones, in half of the windows
_SIZE = 0.05  # spread of a performer's size: of the logarithm of the distance that the hips travel
_TOES = list(TOE_JOINTS)


@dataclass(frozen=True, kw_only=True)
class DenoiserSettings(NetworkSettings):
    """Train the denoiser that denoise begins with."""

    kind = "denoiser"
    used_by = "use it with --denoiser"
    ours = DenoiserConfig()
    shape_options = ("width",)
    least_window = 16

    steps: Count = 16_000
    """Steps in all."""
    batch: Count = 48
    """Windows a step."""
    width: MaybeCount = None
    """Channels of every layer."""

    def make_trainer(self, parts: Split) -> "DenoiserTrainer":
        return DenoiserTrainer(self, parts.train)


class DenoiserTrainer(GradientTrainer[DenoiserNetwork]):
    """Draws windows, corrupts them, and brings the network nearer to cleaning them."""

    def __init__(self, settings: DenoiserSettings, corpus: Corpus):
        """RequestError where no clip is as long as a window."""
        self.windows = FeatureWindows(corpus, settings.window, evenness=_EVENNESS)
        self.config = settings.find_config()
        super().__init__(settings, lambda: DenoiserNetwork(self.config, bfloat16=settings.bfloat16))
        self.begin()

    def losses(self) -> dict[str, Tensor]:
        return self._compare(self.windows, self.generator)

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> Row:
        """Measure the losses of unseen windows, drawn and corrupted alike each time."""
        # What is held out may have no clip as long as a window; that must not end a run after an hour.
        windows = FeatureWindows(corpus, min(self.settings.window, max(corpus.lengths)), evenness=_EVENNESS)
        generator = make_generator(0)
        return average_rows([self._compare(windows, generator) for _ in range(VALIDATED_BATCHES)])

    def _compare(self, windows: FeatureWindows, generator: torch.Generator) -> dict[str, Tensor]:
        drawn = draw_performers(windows, self.settings.batch, generator)
        return compute_denoiser_losses(self.network, drawn, generator)


def draw_performers(
    windows: FeatureWindows, batch: int, generator: torch.Generator
) -> Float[Tensor, "batch window size"]:
    """Draw windows of performers of varied sizes, on rigs calibrated a little differently, in varied poses."""
    features = windows.draw(batch, generator).features.clone()
    size = torch.exp(_SIZE * torch.randn(batch, 1, 1, generator=generator))
    for block in ("root_displacement_heading", "root_height"):
        features[..., LAYOUT.slices[block]] *= size
    features[..., LAYOUT.slices["joint_rotations"]] = _perturb_joint_frames(features, generator)
    return vary_features(features, PoseVariation(), generator)


def _perturb_joint_frames(
    windows: Float[Tensor, "batch window size"], generator: torch.Generator
) -> Float[Tensor, "batch window width"]:
    """Joint rotations (rotation vectors, flat) with every joint's frame turned by a constant; below it nothing turns.

    Bones point a little elsewhere then; what is still stays still.
    """
    batch, others = len(windows), CANONICAL.num_joints - 1
    turns = math.radians(_CALIBRATION_DEG) * torch.randn(batch, 1, others, 3, generator=generator)
    turns = turns * (torch.rand(batch, 1, 1, 1, generator=generator) < 0.5)
    own = rotations.from_rotation_vector(torch.cat([torch.zeros_like(turns[:, :, :1]), turns], dim=2))
    above = own[:, :, [max(0, parent) for parent in CANONICAL.parents]]
    quats = rotations.from_rotation_vector(LAYOUT.pick(windows, "joint_rotations").unflatten(-1, (-1, 3)))
    own, above = (turn[:, :, 1:].expand(quats.shape) for turn in (own, above))
    quats = rotations.multiply(rotations.multiply(rotations.inverse(above), quats), own)
    return rotations.to_rotation_vector(quats).flatten(-2)


def compute_denoiser_losses(network: DenoiserNetwork, windows: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """The loss, and in plain units the errors that add up to it."""
    clean = make_clean_capture(windows)
    cleaned = network(corrupt(clean, generator))
    packed = torch.cat([clean.root, clean.heading[..., None], clean.tilt, clean.joints.flatten(2)], dim=-1)
    bits = LAYOUT.pick(windows, "contacts")
    wanted, got = BodyPose.unpack(packed).joints_world(), cleaned.pose.joints_world()
    position_error = 100 * measure_lengths(got - wanted, 1e-8).mean()
    slip = 100 * measure_lengths(torch.diff(got - wanted, dim=1), 1e-8)
    planted = bits[:, 1:] * bits[:, :-1]
    feet = (slip[..., _TOES] * planted).sum() / planted.sum().clamp_min(1)
    turned = (cleaned.pose.angles - packed[..., 4:]).abs().mean()
    contacts = cross_entropy(cleaned.contact_logits.float(), bits)
    loss = position_error + _PACE * slip.mean() + _FEET * feet + _ANGLES * turned + _CONTACTS * contacts
    spread = _compute_spread_loss(cleaned, packed)
    return {
        "loss": loss + _SPREAD * spread,
        "error_cm": position_error,
        "feet_cm_frame": feet,
        "angles_deg": torch.rad2deg(turned),
        "contacts_nats": contacts,
        "spread_nats": spread,
    }


def _compute_spread_loss(cleaned: CaptureProposal, wanted: Float[Tensor, "batch frames width"]) -> Tensor:
    """Compute the negative log-likelihood of errors under normal distributions of the proposed spreads: of the hips'
    position, of their rotation, and of each other joint's."""
    error = (cleaned.pose.pack() - wanted).detach().square()
    joints = torch.cat([error[..., None, 3:6], error[..., 6:].unflatten(-1, (-1, 3))], dim=-2).mean(dim=-1)
    power = torch.cat([error[..., :3].mean(dim=-1, keepdim=True), joints], dim=-1)
    return (0.5 * power * torch.exp(-2 * cleaned.log_spread) + cleaned.log_spread).mean()
