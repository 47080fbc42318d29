"""Training of the denoiser: windows of clean motion, spoilt anew each time, and how far from them it comes back."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, mirror_features
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.config import require_at_least
from priors.denoiser.network import DenoiserConfig, DenoiserNetwork
from priors.training.augmentation.corruption import CorruptionSettings, corrupt, make_clean_capture
from priors.training.corpus import Corpus, find_window_starts, number_clip_folders
from priors.training.trainer import Trainer

_TOES = list(TOE_JOINTS)


@dataclass(frozen=True)
class DenoiserSettings:
    """The recipe."""

    steps: int = 16_000
    """Updates."""
    batch: int = 48
    """Windows an update."""
    window: int = 64
    """Frames of each."""
    learning_rate: float = 1e-3
    """At its highest; it falls to nothing along a cosine."""
    pace: float = 0.5
    """Weight of the joints' error in velocity, cm a frame, beside 1 for that in place, cm."""
    feet: float = 0.5
    """Weight of the planted toes' error in velocity, cm a frame."""
    angles: float = 10.0
    """Weight of the error of the angles, radians: what turns about its own bone moves no joint."""
    contacts: float = 0.5
    """Weight of the contacts' cross entropy, nats."""
    evenness: float = 0.5
    """Of windows among the data's top folders: 0 draws by their frames, 1 the same number from each."""
    calibration_deg: float = 5.0
    """Spread of a rig's joint frames about the canonical ones, in half of the windows: other rigs find theirs in
    other ways."""
    corruption: CorruptionSettings = field(default_factory=CorruptionSettings)
    """How windows are spoilt."""
    bfloat16: bool = False
    """The network computes in bfloat16; weights and loss stay in float32."""
    seed: int = 1
    """Of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch")
        if self.window < 16:
            raise RequestError(f"window must be at least 16 frames, got {self.window}")


class DenoiserTrainer(Trainer[DenoiserNetwork]):
    """Draws windows, spoils them, and brings the network nearer to cleaning them."""

    def __init__(self, config: DenoiserConfig, settings: DenoiserSettings, corpus: Corpus):
        """RequestError where no clip is as long as a window."""
        self.settings, self.windows = settings, FeatureWindows(corpus, settings)
        super().__init__(
            lambda: DenoiserNetwork(config, bfloat16=settings.bfloat16),
            steps=settings.steps,
            learning_rate=settings.learning_rate,
            seed=settings.seed,
        )

    def losses(self) -> dict[str, Tensor]:
        """Of a batch drawn anew."""
        return compute_denoiser_losses(self.network, self.windows.draw(self.generator), self.settings, self.generator)


class FeatureWindows:
    """Windows of clean motion, as they are drawn for training."""

    def __init__(self, corpus: Corpus, settings: DenoiserSettings):
        """RequestError where no clip is as long as a window."""
        self.corpus, self.settings = corpus, settings
        starts = find_window_starts(corpus.lengths, settings.window)
        folder = number_clip_folders(corpus).repeat_interleave(torch.tensor(corpus.lengths))
        # Grouped, so that drawing a folder and then a window in it needs no table of all windows' chances.
        self.groups = [starts[folder[starts] == number] for number in folder.unique()]
        self.groups = [group for group in self.groups if len(group)]
        self.probabilities = torch.tensor([float(len(group)) for group in self.groups]) ** (1 - settings.evenness)

    def draw(self, generator: torch.Generator) -> Float[Tensor, "batch window size"]:
        """Half of them mirrored, of performers a little larger or smaller, on rigs calibrated a little differently."""
        settings = self.settings
        groups = torch.multinomial(self.probabilities, settings.batch, replacement=True, generator=generator)
        shares = torch.rand(settings.batch, generator=generator)
        picked = torch.stack(
            [
                self.groups[group][int(share * len(self.groups[group]))]
                for group, share in zip(groups.tolist(), shares.tolist(), strict=True)
            ]
        )
        windows = self.corpus.features[picked[:, None] + torch.arange(settings.window)]
        mirrored = torch.rand(settings.batch, generator=generator) < 0.5
        windows = torch.where(mirrored[:, None, None], mirror_features(windows), windows).clone()
        size = torch.exp(settings.corruption.size * torch.randn(settings.batch, 1, 1, generator=generator))
        for block in ("root_displacement_heading", "root_height"):
            windows[..., LAYOUT.slices[block]] *= size
        windows[..., LAYOUT.slices["joint_rotations"]] = _perturb_joint_frames(
            windows, settings.calibration_deg, generator
        )
        return windows


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
    angles = torch.cat([clean.tilt, clean.joints.flatten(2)], dim=-1)
    bits = LAYOUT.pick(windows, "contacts")
    packed = torch.cat([clean.root, clean.heading[..., None], angles], dim=-1)
    wanted, got = BodyPose.unpack(packed).joints_world(), cleaned.pose.joints_world()
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
    return {
        "loss": loss,
        "error_cm": place,
        "feet_cm_frame": feet,
        "angles_deg": torch.rad2deg(turned),
        "contacts_nats": contacts,
    }


def validate(network: DenoiserNetwork, corpus: Corpus, settings: DenoiserSettings) -> dict[str, Any]:
    """The errors on 6 batches of unseen windows, spoilt in the same way each time."""
    generator = torch.Generator().manual_seed(0)
    # What is held out may have no clip as long as a window; that must not end a run after an hour.
    drawn = FeatureWindows(corpus, replace(settings, window=min(settings.window, max(corpus.lengths))))
    rows = []
    with torch.no_grad():
        for _ in range(6):
            windows = drawn.draw(generator)
            rows.append(
                [float(value) for value in compute_denoiser_losses(network, windows, settings, generator).values()]
            )
    names = ("loss", "error_cm", "feet_cm_frame", "angles_deg", "contacts_nats")
    return dict(zip(names, torch.tensor(rows).mean(dim=0).tolist(), strict=True))


def _smooth_norm(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """With a gradient at zero."""
    return torch.sqrt(vector.square().sum(dim=-1) + 1e-8)
