"""Tracking of another motion: of its poses, and of its trajectory over the ground from the window's beginning on."""

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, integrate_root
from mapctl.rotations import rotate_about_y
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class MotionTracking:
    """The poses are near those of a target motion, and so is the trajectory.

    Poses are compared as joint positions relative to the hips' position and heading; trajectories from the window's
    first frame on, not in the world: where sliding feet stand instead, the character falls a little behind the
    target with each step, which costs nothing in later windows.
    """

    target: Float[Tensor, "frames size"]
    """Features of the window's frames, physical units."""
    sigma_pose: float = 0.03
    """Standard deviation of a joint about the target's, relative to the hips, metres."""
    sigma_height: float = 0.03
    """Standard deviation of the height of the hips, metres."""
    sigma_trajectory: float = 0.15
    """Standard deviation of the position of the hips over the ground since the window's beginning, metres."""
    sigma_heading: float = 0.15
    """Standard deviation of the heading since the window's beginning, radians."""
    effective_joints: float = 6.0
    """Number of independent joints that a body is worth: neighbours move together, so 21 are not 21 observations."""
    name: str = "closeness"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats."""
        height = LAYOUT.pick(trial.features - self.target.to(trial.features), "root_height")[..., 0]
        ground, turn = self._trajectory_error(trial)
        return 0.5 * (
            self.effective_joints * self._pose(trial).mean(-1) / self.sigma_pose**2
            + (height / self.sigma_height).square()
            + ground.square().sum(-1) / self.sigma_trajectory**2
            + (turn / self.sigma_heading).square()
        )

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the root mean square distance of the joints from the target's, relative to the hips, metres."""
        return self._pose(trial).mean(-1).sqrt()

    def _pose(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        """Squared distances, m^2."""
        own = _hips_relative_positions(trial)
        return (own - self._target_from_hips(trial).to(own)).square().sum(-1)

    def _trajectory_error(self, trial: Trial) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
        """Ground position (metres) and heading (radians) of the hips less the target's, from one ground pose."""
        ground, heading = integrate_root(self.target.to(trial.features), trial.start)
        return trial.root_xz_world - ground, trial.heading - heading

    def _target_from_hips(self, trial: Trial) -> Float[Tensor, "1 frames joints 3"]:
        key = id(trial.skeleton)
        if key not in self._target_cache:
            other = Trial.of_features(self.target.unsqueeze(0), skeleton=trial.skeleton)
            self._target_cache[key] = _hips_relative_positions(other)
        return self._target_cache[key]

    @cached_property
    def _target_cache(self) -> dict[int, Tensor]:
        """The target's joint positions by skeleton: a term is evaluated many times in one window."""
        return {}


def _hips_relative_positions(trial: Trial) -> Float[Tensor, "batch frames joints 3"]:
    """Joint positions less the hips', in the heading frame."""
    return rotate_about_y(trial.joints_world - trial.joints_world[..., :1, :], -trial.heading[..., None])
