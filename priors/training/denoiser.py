"""Training of the denoiser: windows of clean motion, spoilt anew each time, and how far from them it comes back."""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, mirror_features
from mapctl.skeleton import CANONICAL
from priors.denoiser import Cleaned, DenoiserConfig, DenoiserNetwork
from priors.training import run_files
from priors.training.corpus import Corpus, window_starts
from priors.training.corruption import CorruptionSettings, clean_capture, corrupted

_TOES = [CANONICAL.index("leftToes"), CANONICAL.index("rightToes")]
_WARM_UP = 0.05  # share of the steps in which the learning rate rises


@dataclass(frozen=True)
class DenoiserSettings:
    """The recipe."""

    steps: int = 20_000
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
    corruption: CorruptionSettings = field(default_factory=CorruptionSettings)
    """How windows are spoilt."""
    bfloat16: bool = False
    """The network computes in bfloat16; weights and loss stay in float32."""
    seed: int = 1
    """Of weights, windows and noise."""

    def __post_init__(self):
        for name in ("steps", "batch"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.window < 16:
            raise RequestError(f"window must be at least 16 frames, got {self.window}")


class DenoiserTrainer:
    """Network, optimiser and generator, one step at a time."""

    def __init__(self, config: DenoiserConfig, settings: DenoiserSettings, corpus: Corpus):
        self.settings, self.corpus, self.step = settings, corpus, 0
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.starts = window_starts(corpus.lengths, settings.window)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(settings.seed)
            self.network = DenoiserNetwork(config, bfloat16=settings.bfloat16)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=settings.learning_rate, weight_decay=1e-4)

    def train_step(self) -> dict[str, float]:
        """One update; the parts of its loss."""
        windows = draw_windows(self.corpus, self.starts, self.settings, self.generator)
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * _rate(self.step, self.settings.steps)
        parts = losses(self.network, windows, self.settings, self.generator)
        self.optimiser.zero_grad()
        parts["loss"].backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        return {name: float(value.detach()) for name, value in parts.items()}

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs, but the step."""
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= run_files.optimiser_tensors(self.optimiser, "optimiser")
        return tensors | {"generator": self.generator.get_state()}

    def load_state(self, tensors: dict[str, Tensor], step: int) -> None:
        """Inverse of `state`; KeyError or RuntimeError for tensors that are not its."""
        own = {n.removeprefix("network."): t for n, t in tensors.items() if n.startswith("network.")}
        self.network.load_state_dict(own)
        self.optimiser.load_state_dict(run_files.optimiser_state(self.optimiser, "optimiser", tensors))
        self.generator.set_state(tensors["generator"])
        self.step = step


def draw_windows(
    corpus: Corpus, starts: Tensor, settings: DenoiserSettings, generator: torch.Generator
) -> Float[Tensor, "batch window size"]:
    """Windows of clean motion, half of them mirrored, of performers a little larger or smaller."""
    picked = starts[torch.randint(len(starts), (settings.batch,), generator=generator)]
    windows = corpus.features[picked[:, None] + torch.arange(settings.window)]
    mirrored = torch.rand(settings.batch, generator=generator) < 0.5
    windows = torch.where(mirrored[:, None, None], mirror_features(windows), windows).clone()
    size = torch.exp(settings.corruption.size * torch.randn(settings.batch, 1, 1, generator=generator))
    for block in ("root_displacement_heading", "root_height"):
        windows[..., LAYOUT.slices[block]] *= size
    return windows


def losses(
    network: DenoiserNetwork, windows: Tensor, settings: DenoiserSettings, generator: torch.Generator
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors it is made of."""
    clean = clean_capture(windows)
    cleaned = network(corrupted(clean, settings.corruption, generator))
    angles = torch.cat([clean.tilt, clean.joints.flatten(2)], dim=-1)
    bits = LAYOUT.pick(windows, "contacts")
    wanted = joint_positions(Cleaned(clean.root, clean.heading, angles, bits))
    got = joint_positions(cleaned)
    place = 100 * _length(got - wanted).mean()
    slip = 100 * _length(torch.diff(got - wanted, dim=1))
    planted = bits[:, 1:] * bits[:, :-1]
    feet = (slip[..., _TOES] * planted).sum() / planted.sum().clamp_min(1)
    turned = (cleaned.angles - angles).abs().mean()
    contacts = cross_entropy(cleaned.contacts.float(), bits)
    loss = (place + settings.pace * slip.mean() + settings.feet * feet + settings.angles * turned
            + settings.contacts * contacts)  # fmt: skip
    return {"loss": loss, "error_cm": place, "feet_cm_frame": feet, "angles_deg": torch.rad2deg(turned),
            "contacts_nats": contacts}  # fmt: skip


def joint_positions(cleaned: Cleaned) -> Float[Tensor, "batch frames joints 3"]:
    """In the world on canonical bones, metres."""
    tilt, others = cleaned.angles[..., :2], cleaned.angles[..., 2:].unflatten(-1, (-1, 3))
    hips = torch.stack([tilt[..., 0], torch.zeros_like(cleaned.heading), tilt[..., 1]], dim=-1)
    turns = rotations.rotation_vector_to_matrix(torch.cat([hips[..., None, :], others], dim=-2))
    x, y, z = kinematics.positions_from_matrices(CANONICAL, turns).unbind(-1)
    sine, cosine = torch.sin(cleaned.heading)[..., None], torch.cos(cleaned.heading)[..., None]
    turned = torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], dim=-1)
    return turned + cleaned.root[..., None, :]


def validate(network: DenoiserNetwork, corpus: Corpus, settings: DenoiserSettings) -> dict[str, Any]:
    """The errors on 6 batches of unseen windows, spoilt in the same way each time."""
    generator = torch.Generator().manual_seed(0)
    starts = window_starts(corpus.lengths, settings.window)
    rows = []
    with torch.no_grad():
        for _ in range(6):
            windows = draw_windows(corpus, starts, settings, generator)
            rows.append([float(value) for value in losses(network, windows, settings, generator).values()])
    names = ("loss", "error_cm", "feet_cm_frame", "angles_deg", "contacts_nats")
    return dict(zip(names, torch.tensor(rows).mean(dim=0).tolist(), strict=True))


def _length(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """With a gradient at zero."""
    return torch.sqrt(vector.square().sum(dim=-1) + 1e-8)


def _rate(step: int, steps: int) -> float:
    """Of the highest learning rate: rising, then along a cosine to nothing."""
    rise = max(1, round(_WARM_UP * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))
