"""Where joints are: at target positions, within reach of them, clear of obstacles, apart from other characters; and
without a pop where a window begins."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.skeleton import CANONICAL
from mapctl.terms.base import length
from mapctl.terms.trial import Trial

_WIDEST = CANONICAL.indices(("hips", "leftHand", "rightHand", "leftLowerArm", "rightLowerArm", "leftToes", "rightToes"))
_LINEAR_FROM = 0.1  # metres beyond reach from which the energy rises linearly, so that no target causes a lunge


@dataclass(frozen=True, eq=False)
class KeepClear:
    """No joint is inside an obstacle, or nearer to it than a margin."""

    obstacles: tuple[Obstacle, ...]
    """Obstacles in the world."""
    margin: float = 0.05
    """Distance from their edges within which a joint costs, metres."""
    sigma: float = 0.02
    """Standard deviation of the distance by which a joint is too near, metres."""
    name: str = "clear"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies of the joints that reach farthest from the body, nats."""
        return 0.5 * (self._measure_intrusion(trial) / self.sigma).square().sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the distance by which the joint that is nearest to an obstacle is nearer than the margin, metres."""
        return self._measure_intrusion(trial).amax(-1)

    def _measure_intrusion(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        ground = trial.joints_world[..., list(_WIDEST), ::2]
        return (self.margin - measure_clearance(self.obstacles, ground)).clamp_min(0)


@dataclass(frozen=True, eq=False)
class KeepApart:
    """The hips stay away from those of others, whose trajectories are known."""

    others: Float[Tensor, "others frames 2"]
    """Hips of the others on the ground in each frame of the window, x and z, metres."""
    distance: float
    """Least distance of hips, metres."""
    sigma: float = 0.02
    """Standard deviation of the shortfall of that distance, metres."""
    name: str = "apart"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats, summed over the others."""
        return 0.5 * (self._measure_shortfall(trial) / self.sigma).square().sum(1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the largest shortfall of the distance to another, metres."""
        return self._measure_shortfall(trial).amax(1)

    def _measure_shortfall(self, trial: Trial) -> Float[Tensor, "batch others frames"]:
        away = trial.root_xz_world[:, None] - self.others.to(trial.features)
        return (self.distance - length(away)).clamp_min(0)


@dataclass(frozen=True, eq=False)
class WithinReach:
    """A shoulder is near enough to a target for the hand to reach it."""

    shoulder: int
    """Index of the canonical joint from which the limb reaches."""
    position: Float[Tensor, "frames 3"]
    """Target in each frame of the window, world, metres; anything finite where there is none."""
    wanted: Bool[Tensor, " frames"]
    """Whether there is a target in a frame."""
    reach: float
    """Distance that the limb reaches without strain, metres."""
    sigma: float = 0.02
    """Standard deviation of the distance beyond reach, metres."""
    name: str = "within reach"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats."""
        shortfall = self.residual(trial) / _LINEAR_FROM
        return (_LINEAR_FROM / self.sigma) ** 2 * ((1 + shortfall.square()).sqrt() - 1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the distance beyond reach, metres; 0 where the limb reaches."""
        away = trial.joints_world[..., self.shoulder, :] - self.position.to(trial.features)
        return (length(away) - self.reach).clamp_min(0) * self.wanted


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Joints are at target positions in the world. Whole poses that are given need no term: they are no unknowns."""

    positions: Float[Tensor, "frames joints 3"]
    """Target positions in the world, metres; anything finite where there is no target."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a joint has a target in a frame."""
    sigma: float = 0.002
    """Standard deviation of a joint about its target along each axis, metres."""
    name: str = "keyframe"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats, summed over joints."""
        return 0.5 * (self._squares(trial) / self.sigma**2).sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the distance of the joint that is farthest from its target, metres; 0 where there is none."""
        return torch.sqrt(self._squares(trial).amax(-1))

    def _squares(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        """Squared distances, m^2."""
        error = trial.joints_world - self.positions.to(trial.features)
        return error.square().sum(-1) * self.wanted


@dataclass(frozen=True)
class Jerk:
    """The joints' jerk is small over the first frames of the window, taken together with the frames before it."""

    sigma: float = 400.0
    """Standard deviation of a joint's jerk, m/s^3: mocap walks at 100 in the mean, several hundred at heel strike."""
    frames: int = 3
    """Number of frames that the seam reaches into the window."""
    name: str = "seam"
    unit: str = "m/s^3"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats, mean over joints; 0 beyond the seam and with fewer than three frames before the
        window."""
        return 0.5 * (self._jerk(trial) / self.sigma).square().mean(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the mean jerk over joints, m/s^3."""
        return self._jerk(trial).mean(-1)

    def _jerk(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        positions, frames = trial.joints_world, min(self.frames, trial.joints_world.shape[1])
        jerk = positions.new_zeros(positions.shape[:3])
        if len(trial.before) < 3:
            return jerk
        past = trial.before[-3:].to(positions.dtype).expand(len(positions), -1, -1, -1)
        third = torch.diff(torch.cat([past, positions[:, :frames]], dim=1), n=3, dim=1) * trial.fps**3
        third = torch.sqrt(third.square().sum(-1) + 1e-9)
        return torch.cat([third, jerk[:, frames:]], dim=1)
