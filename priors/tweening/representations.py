"""Which numbers a network should tell rotations by: the inverse kinematics of Zhou et al. 2019, section 5.3, as Zhou et
al. 2020, table 1, repeat it. Positions of joints in, rotations out, and forward kinematics leads back to positions.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.skeleton import CANONICAL
from priors.tweening.range_constrained import POSE_ROWS, RangeConstrainedKinematics

_JOINTS = CANONICAL.num_joints
_HIPS_ORDER, _ORDER = "YXZ", "XZY"  # of the plain angles: the heading first, and the order of Zhou et al. 2020
_CHUNK = 4096  # poses that are measured at once


@dataclass(frozen=True)
class Representation:
    """Numbers that stand for the rotations of a body."""

    name: str
    """Name in the table."""
    rows: int
    """How many there are of a pose."""
    place: Callable[[Tensor], Tensor]
    """Where they put the joints: (batch, rows) to (batch, joints, 3), metres from the hips."""


@dataclass(frozen=True)
class IkSettings:
    """How the networks are trained; all alike."""

    steps: int = 20_000
    """Steps, from one to as many as there is patience for; the paper took about a million."""
    batch: int = 256
    """Poses of a step, each at a random heading."""
    width: int = 512
    """Width of the four hidden layers."""
    learning_rate: float = 1e-3
    """Of Adam at the beginning; it falls to nothing along a cosine."""
    seed: int = 0
    """Seed of weights, poses and headings."""

    def __post_init__(self):
        if min(self.steps, self.batch, self.width) < 1:
            raise RequestError(f"steps, poses of a step and width must be positive, got {self}")


@dataclass(frozen=True)
class IkErrors:
    """Distances of joints from where they are to be, over poses and joints but the hips, cm."""

    mean: float
    """Their mean."""
    largest: float
    """The largest one."""
    deviation: float
    """Their standard deviation."""

    @staticmethod
    def of_distances(metres: Float[Tensor, "poses joints"]) -> "IkErrors":
        """Summarise."""
        cm = 100 * metres.double()
        return IkErrors(float(cm.mean()), float(cm.max()), float(cm.std(unbiased=False)))


def list_representations() -> tuple[Representation, ...]:
    """List those of table 1, and six numbers for all joints."""
    constrained = RangeConstrainedKinematics()
    axes = rotations.euler_axes([_HIPS_ORDER, *[_ORDER] * (_JOINTS - 1)])
    return (
        Representation("quaternions", 4 * _JOINTS, lambda rows: _chain(_quaternions_to_matrices(rows))),
        Representation(
            "Euler angles",
            3 * _JOINTS,
            lambda rows: _chain(rotations.from_euler(rows.unflatten(-1, (_JOINTS, 3)), axes)),
        ),
        Representation("Euler angles in their ranges, 6-D hips", POSE_ROWS, lambda rows: constrained(rows).places),
        Representation("6-D", 6 * _JOINTS, lambda rows: _chain(rotations.from_six(rows.unflatten(-1, (_JOINTS, 6))))),
    )


def place_poses(features: Float[Tensor, "frames size"]) -> Float[Tensor, "frames joints 3"]:
    """Place the joints of frames of a corpus, metres from the hips, seen along the hips' heading."""
    vectors = LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))
    tilt = LAYOUT.pick(features, "root_tilt")
    hips = torch.stack([tilt[..., 0], torch.zeros_like(tilt[..., 0]), tilt[..., 1]], dim=-1)
    parts = torch.cat([hips[:, None], vectors], dim=1).split(_CHUNK)
    return torch.cat([_chain(rotations.rotation_vector_to_matrix(part)) for part in parts])


class InverseKinematicsNetwork(nn.Module):
    """Joint positions in, the numbers of a representation out: four hidden layers."""

    def __init__(self, rows: int, *, width: int, unit: float):
        """Positions are seen in this unit, metres."""
        super().__init__()
        sizes, self.unit = (3 * _JOINTS, *[width] * 4), unit
        hidden = [layer for ins, outs in pairwise(sizes) for layer in (nn.Linear(ins, outs), nn.LeakyReLU())]
        self.layers = nn.Sequential(*hidden, nn.Linear(width, rows))

    def forward(self, places: Float[Tensor, "batch joints 3"]) -> Float[Tensor, "batch rows"]:
        """Tell the numbers of poses."""
        return self.layers(places.flatten(1) / self.unit)


def train_inverse_kinematics(
    representation: Representation,
    places: Float[Tensor, "frames joints 3"],
    settings: IkSettings,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> InverseKinematicsNetwork:
    """Train on poses, seen along their heading, by the squared distances of the joints that the answer leads back
    to; one seed draws the same poses for every representation."""
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        unit = float(places[:, 1:].square().mean().sqrt())
        network = InverseKinematicsNetwork(representation.rows, width=settings.width, unit=unit)
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
    drawn = torch.Generator().manual_seed(settings.seed)
    for step in range(settings.steps):
        chosen = torch.randint(len(places), (settings.batch,), generator=drawn)
        wanted = turn_at_random(places[chosen], drawn)
        off = representation.place(network(wanted)) - wanted
        optimiser.zero_grad()
        off.square().sum(dim=-1).mean().backward()
        optimiser.step()
        schedule.step()
        if progress is not None:
            progress(step + 1, settings.steps)
    return network.eval().requires_grad_(False)


def measure_inverse_kinematics(
    representation: Representation,
    network: InverseKinematicsNetwork,
    places: Float[Tensor, "frames joints 3"],
    *,
    seed: int,
) -> IkErrors:
    """Measure a network on poses, each at a heading that the seed draws."""
    wanted = turn_at_random(places, torch.Generator().manual_seed(seed))
    made = torch.cat([representation.place(network(part)) for part in wanted.split(_CHUNK)])
    return IkErrors.of_distances((made - wanted).norm(dim=-1)[:, 1:])


def measure_mean_pose(train: Float[Tensor, "frames joints 3"], places: Float[Tensor, "poses joints 3"]) -> IkErrors:
    """Measure who answers every pose with the mean of those of training, and is told the heading."""
    return IkErrors.of_distances((places - train.mean(dim=0)).norm(dim=-1)[:, 1:])


def turn_at_random(places: Float[Tensor, "poses joints 3"], generator: torch.Generator) -> Tensor:
    """Turn each pose to a heading of its own."""
    turns = 2 * math.pi * torch.rand(len(places), 1, generator=generator)
    return rotations.rotate_about_y(places, turns)


def _quaternions_to_matrices(rows: Float[Tensor, "batch rows"]) -> Float[Tensor, "batch joints 3 3"]:
    return rotations.to_matrix(normalize(rows.unflatten(-1, (_JOINTS, 4)), dim=-1))


def _chain(local_matrix: Float[Tensor, "batch joints 3 3"]) -> Float[Tensor, "batch joints 3"]:
    return kinematics.positions_from_matrices(CANONICAL, local_matrix)
