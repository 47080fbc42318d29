"""Training of the denoiser: windows of clean motion, spoilt anew each time, and how far from them it comes back."""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.pose import BodyPose
from mapctl.recording import Capture, CaptureProposal
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.checkpoints import require_at_least
from priors.denoiser import DenoiserConfig, DenoiserNetwork
from priors.training.augment import CorruptionSettings, corrupt, make_clean_capture
from priors.training.data import Corpus
from priors.training.loop import GradientTrainer, NetworkRecipe, Row, average_logarithms, make_generator
from priors.training.windows import FeatureWindows, PoseVariation, vary_features

_TOES = list(TOE_JOINTS)


@dataclass(frozen=True)
class DenoiserSettings:
    """How a denoiser is trained."""

    steps: int = 16_000
    """Updates."""
    batch: int = 48
    """Windows an update."""
    window: int = 64
    """Frames of each."""
    learning_rate: float = 1e-3
    """At its highest; it falls to nothing along a cosine."""
    pace: float = 0.5
    """Weight of the joints' velocity error, cm a frame; that of the position error, cm, is 1."""
    feet: float = 0.5
    """Weight of the planted toes' error in velocity, cm a frame."""
    angles: float = 20.0
    """Weight of the error of the angles, radians: what turns about its own bone moves no joint."""
    contacts: float = 0.5
    """Weight of the contacts' cross entropy, nats."""
    evenness: float = 0.5
    """How evenly windows are drawn from the data's top folders: 0 by their frames, 1 the same number from each."""
    calibration_deg: float = 5.0
    """Spread of a rig's joint frames about the canonical ones, in half of the windows: other rigs find theirs in
    other ways."""
    poses: PoseVariation = field(default_factory=PoseVariation)
    """How far poses leave those of the clips."""
    spread: float = 0.1
    """Weight of the negative log-likelihood of the errors, which only the spread's own layer learns from."""
    corruption: CorruptionSettings = field(default_factory=CorruptionSettings)
    """How windows are spoilt."""
    bfloat16: bool = False
    """The network computes in bfloat16; weights and loss stay in float32."""
    seed: int = 1
    """Seed of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch")
        if self.window < 16:
            raise RequestError(f"window must be at least 16 frames, got {self.window}")


class DenoiserTrainer(GradientTrainer[DenoiserNetwork]):
    """Draws windows, spoils them, and brings the network nearer to cleaning them."""

    def __init__(self, config: DenoiserConfig, settings: DenoiserSettings, corpus: Corpus):
        """RequestError where no clip is as long as a window."""
        self.windows = FeatureWindows(corpus, settings.window, evenness=settings.evenness)
        super().__init__(lambda: DenoiserNetwork(config, bfloat16=settings.bfloat16), settings)

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        windows = draw_performers(self.windows, self.settings, self.generator, batch=self.settings.batch)
        return compute_denoiser_losses(self.network, windows, self.settings, self.generator)

    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the errors on 6 batches of held-out windows, corrupted identically each time."""
        settings, generator, rows = self.settings, make_generator(0), []
        # What is held out may have no clip as long as a window; that must not end a run after an hour.
        drawn = FeatureWindows(corpus, min(settings.window, max(corpus.lengths)), evenness=settings.evenness)
        with torch.no_grad():
            for _ in range(6):
                windows = draw_performers(drawn, settings, generator)
                rows.append(compute_denoiser_losses(self.network, windows, settings, generator))
        means = torch.stack([torch.stack(list(row.values())) for row in rows]).mean(dim=0)
        return dict(zip(rows[0], means.tolist(), strict=True))


@dataclass(frozen=True)
class DenoiserRecipe(NetworkRecipe[DenoiserConfig, DenoiserSettings, DenoiserTrainer]):
    """What to train a denoiser on, and how."""

    kind = "denoiser"
    trainer_class = DenoiserTrainer
    config: DenoiserConfig = field(default_factory=DenoiserConfig)
    settings: DenoiserSettings = field(default_factory=DenoiserSettings)

    def score(self, row: Row) -> float:
        """The loss of unseen windows."""
        return average_logarithms([row.get("loss")])


def draw_performers(
    windows: FeatureWindows, settings: DenoiserSettings, generator: torch.Generator, *, batch: int | None = None
) -> Float[Tensor, "batch window size"]:
    """Windows of performers a little larger or smaller, on rigs calibrated a little differently, in varied poses."""
    batch = batch or settings.batch
    features = windows.draw(batch, generator).features.clone()
    size = torch.exp(settings.corruption.size * torch.randn(batch, 1, 1, generator=generator))
    for block in ("root_displacement_heading", "root_height"):
        features[..., LAYOUT.slices[block]] *= size
    features[..., LAYOUT.slices["joint_rotations"]] = _perturb_joint_frames(
        features, settings.calibration_deg, generator
    )
    return vary_features(features, settings.poses, generator)


def _perturb_joint_frames(
    windows: Float[Tensor, "batch window size"], spread_deg: float, generator: torch.Generator
) -> Float[Tensor, "batch window width"]:
    """Joint rotations (rotation vectors, flat) with every joint's frame turned by a constant; below it nothing turns.

    Bones point a little elsewhere then; what is still stays still.
    """
    batch, others = len(windows), CANONICAL.num_joints - 1
    turns = math.radians(spread_deg) * torch.randn(batch, 1, others, 3, generator=generator)
    turns = turns * (torch.rand(batch, 1, 1, 1, generator=generator) < 0.5)
    own = rotations.from_rotation_vector(torch.cat([torch.zeros_like(turns[:, :, :1]), turns], dim=2))
    above = own[:, :, [max(0, parent) for parent in CANONICAL.parents]]
    quats = rotations.from_rotation_vector(LAYOUT.pick(windows, "joint_rotations").unflatten(-1, (-1, 3)))
    own, above = (turn[:, :, 1:].expand(quats.shape) for turn in (own, above))
    quats = rotations.multiply(rotations.multiply(rotations.inverse(above), quats), own)
    return rotations.to_rotation_vector(quats).flatten(-2)


def compute_denoiser_losses(
    network: DenoiserNetwork, windows: Tensor, settings: DenoiserSettings, generator: torch.Generator
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors it is made of."""
    clean = make_clean_capture(windows)
    cleaned = network(corrupt(clean, settings.corruption, generator))
    angles = _pack_angles(clean)
    bits = LAYOUT.pick(windows, "contacts")
    wanted, got = BodyPose.unpack(_pack(clean)).joints_world(), cleaned.pose.joints_world()
    place = 100 * _smooth_norm(got - wanted).mean()
    slip = 100 * _smooth_norm(torch.diff(got - wanted, dim=1))
    planted = bits[:, 1:] * bits[:, :-1]
    feet = (slip[..., _TOES] * planted).sum() / planted.sum().clamp_min(1)
    turned = (cleaned.pose.angles - angles).abs().mean()
    contacts = cross_entropy(cleaned.contact_logits.float(), bits)
    loss = (
        place
        + settings.pace * slip.mean()
        + settings.feet * feet
        + settings.angles * turned
        + settings.contacts * contacts
    )
    spread = _compute_spread_loss(cleaned, _pack(clean))
    return {
        "loss": loss + settings.spread * spread,
        "error_cm": place,
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


def _pack_angles(clean: Capture) -> Float[Tensor, "batch frames angles"]:
    return torch.cat([clean.tilt, clean.joints.flatten(2)], dim=-1)


def _pack(clean: Capture) -> Float[Tensor, "batch frames width"]:
    """The pose of clean motion as BodyPose packs it."""
    return torch.cat([clean.root, clean.heading[..., None], _pack_angles(clean)], dim=-1)


def _smooth_norm(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """With a gradient at zero."""
    return torch.sqrt(vector.square().sum(dim=-1) + 1e-8)
