"""The adversarial refiner: a residual LSTM after which sampled motion looks captured (Wang et al. 2019, section 4.2,
Eq. 11).

State and end effectors through a layer, an LSTM and a layer give what is added to the state. Two departures: the first
layer also sees some frames ahead, since tremble cannot be distinguished from motion without what follows; and the
residual is bounded, so that no input can make it explode. Contact bits are in its input and in its output (section
4.3). End effectors are in the input because the density's features hold little of where hands and feet end up, and that
is where a viewer looks (section 4.2.1).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.protocols import Refiner
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Size


def compute_end_effectors(
    features: Float[Tensor, "batch frames size"], joints: Sequence[str]
) -> Float[Tensor, "batch later channels"]:
    """Compute for each frame but the first: positions (m) relative to the hips' ground point and heading, then
    velocities (m/s) over the ground from the frame before, in the same heading frame, so that a planted foot has none.
    """
    trial = Trial.of_features(features)
    world = trial.joints_world[..., [CANONICAL.index(name) for name in joints], :]
    velocity = torch.diff(world, dim=1) * PRIOR_FPS
    position = world[:, 1:] - rotations.lift_ground(trial.root_xz_world[:, 1:, None])
    vectors = torch.cat([position, velocity], dim=2)
    return rotations.rotate_about_y(vectors, -trial.heading[:, 1:, None]).flatten(2)


END_EFFECTORS = (
    "hips",
    "head",
    "leftLowerArm",
    "leftHand",
    "rightLowerArm",
    "rightHand",
    "leftLowerLeg",
    "leftFoot",
    "leftToes",
    "rightLowerLeg",
    "rightFoot",
    "rightToes",
)
"""End effectors of the refiner and its critic: the limbs' ends of Wang et al. 2019, and joints that tremble too."""

_CONTACT_LOGIT = 3.0  # logit that a contact bit of the input is worth; the network may overrule it
_CHUNK_FRAMES = 600  # frames refined at once


@dataclass(frozen=True)
class RefinerConfig(NetworkConfig):
    """Shape of the network."""

    width: Size = 256
    """Units of the first layer (Wang et al. 2019: 500)."""
    memory: Size = 256
    """Units of the LSTM (Wang et al. 2019: 1000)."""
    lookahead: Annotated[int, Field(ge=0, le=64)] = 4
    """Frames ahead, and behind, that the first layer sees; Wang et al. 2019: 0."""
    limit: Annotated[float, Field(gt=0)] = 2.0
    """Bound of what is added, standard deviations of each feature."""
    joints: tuple[str, ...] = END_EFFECTORS
    """Names of the joints whose positions and velocities are inputs."""

    def __post_init__(self):
        if not self.joints or not set(self.joints) <= set(CANONICAL.names):
            raise RequestError(f"a refiner needs end effectors among {', '.join(CANONICAL.names)}, got {self.joints}")


PAPER = RefinerConfig(
    width=500, memory=1000, lookahead=0, limit=1e6, joints=("head", "leftHand", "rightHand", "leftToes", "rightToes")
)
"""The network of Wang et al. 2019, section 4.2."""


class RefinerNetwork(nn.Module):
    """Features in and out in physical units; statistics inside. Untrained, it returns what it was given."""

    mean: Tensor
    std: Tensor
    reach_mean: Tensor
    reach_std: Tensor

    def __init__(self, config: RefinerConfig, **statistics: Tensor):
        """Take statistics of the features, `mean` and `std` (size,), and of `compute_end_effectors`, `reach_mean` and
        `reach_std` (channels,); RuntimeError for other widths."""
        super().__init__()
        self.config = config
        reach = 6 * len(config.joints)
        for name, width in (("mean", LAYOUT.size), ("std", LAYOUT.size), ("reach_mean", reach), ("reach_std", reach)):
            self.register_buffer(name, statistics.get(name, torch.ones(())).expand(width).clone())
        seen = 2 * config.lookahead + 1
        self.first = nn.Conv1d(LAYOUT.size + reach, config.width, seen)
        self.lstm = nn.LSTM(config.width, config.memory, batch_first=True)
        self.last = nn.Linear(config.memory, LAYOUT.size)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    @property
    def before(self) -> int:
        """Frames of input before the first refined one; as many less one are needed after the last."""
        return self.config.lookahead + 1

    def forward(
        self, features: Float[Tensor, "batch given size"], memory: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Float[Tensor, "batch refined size"], tuple[Tensor, Tensor]]:
        """Return refined frames [lookahead + 1, given - lookahead), bits as probabilities, and the LSTM's memory."""
        reach = (compute_end_effectors(features, self.config.joints) - self.reach_mean) / self.reach_std
        seen = torch.cat([((features - self.mean) / self.std)[:, 1:], reach], dim=-1)
        hidden, after = self.lstm(torch.relu(self.first(seen.transpose(1, 2))).transpose(1, 2), memory)
        change = self.last(hidden).to(features.dtype)
        own = features[:, self.before : features.shape[1] - self.config.lookahead]
        size, limit = LAYOUT.continuous, self.config.limit
        continuous = own[..., :size] + limit * torch.tanh(change[..., :size] / limit) * self.std[:size]
        bits = torch.sigmoid(_CONTACT_LOGIT * (2 * own[..., size:] - 1) + change[..., size:])
        return torch.cat([continuous, bits], dim=-1), after


@dataclass(frozen=True, eq=False, repr=False)
class LstmRefiner(checkpoints.NetworkModel[RefinerNetwork], Refiner):
    """A trained refiner."""

    kind, parts = "refiner", (RefinerNetwork, RefinerConfig)

    def stream(self, pieces: Iterable[Float[Tensor, "batch _ size"]]) -> Iterator[Float[Tensor, "batch _ size"]]:
        """Refine consecutive pieces, `lookahead` frames behind their input, in memory that does not grow.

        At both ends the motion is taken to go on as its outermost frame does.
        """
        ahead, held, memory = self.network.config.lookahead, None, None
        for piece in _pad_ends(pieces, before=self.network.before, after=ahead):
            held = piece if held is None else torch.cat([held, piece], dim=1)
            while held.shape[1] > self.network.before + ahead:
                given = held[:, : self.network.before + ahead + _CHUNK_FRAMES]
                with torch.no_grad():
                    refined, memory = self.network(given, memory)
                held = held[:, refined.shape[1] :]
                yield torch.cat([refined[..., : LAYOUT.continuous], (refined[..., LAYOUT.continuous :] > 0.5)], dim=-1)


def _pad_ends(pieces: Iterable[Tensor], *, before: int, after: int) -> Iterator[Tensor]:
    last = None
    for piece in pieces:
        if piece.shape[1] == 0:
            continue
        if last is None:
            yield piece[:, :1].expand(-1, before, -1)
        yield piece
        last = piece[:, -1:]
    if last is not None and after > 0:
        yield last.expand(-1, after, -1)
