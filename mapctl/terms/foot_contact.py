"""Feet: planted toes and heels do not move and are on the ground (Wang et al. 2019, Eq. 18), and land without a snap;
toes that travel clear the ground.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.skeleton import TOE_REST_HEIGHT, find_heel_drops
from mapctl.terms.base import TrialGradient
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class HeelSigmas:
    """How far planted heels may be from resting: mocap's own move and sink more than its toes."""

    speed: float = 0.1
    """Standard deviation of the horizontal speed of a planted heel, m/s. Half of it holds heels better still, but toes,
    paths and jitter pay for that."""
    height: float = 0.02
    """Standard deviation of the height of a planted heel about its rest height, metres."""
    below: float = 0.01
    """Standard deviation of the depth of any heel below its rest height, metres."""
    doubt: float = 4.0
    """Energy of a planted heel, nats, from which on it counts less and less: a foot may roll off earlier than the plan
    from which its contacts come, as where a command changes."""

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Standard deviations of speed, height and depth."""
        return self.speed, self.height, self.below


@dataclass(frozen=True)
class LandingSigmas:
    """How hard toes may be accelerated. Contacts are fixed while a window is solved, and hold a toe from the second of
    its frames on: without this the first may be anywhere, and a foot can snap to its position within one frame."""

    free: float = 70.0
    """Acceleration of a toe that costs nothing, m/s^2."""
    sigma: float = 10.0
    """Standard deviation of what is beyond it, m/s^2."""

    def scale(self, factor: float) -> "LandingSigmas":
        """Return both times `factor`, a ratio of sizes, for a body of another size."""
        return LandingSigmas(factor * self.free, factor * self.sigma)

    def differentiate(
        self, before: Float[np.ndarray, "known 2 3"], toes: Float[np.ndarray, "batch frames 2 3"], fps: float
    ) -> tuple[Float[np.ndarray, "batch frames"], Float[np.ndarray, "batch frames 2 3"]]:
        """Return the energies of toes, nats, and their gradient; `before` are up to two frames before the window."""
        past = np.broadcast_to(before, (len(toes), *before.shape))
        second = fps**2 * np.diff(np.concatenate([past, toes], axis=1), n=2, axis=1)
        sizes = np.sqrt(np.square(second).sum(-1) + 1e-9 * fps**4)
        beyond = np.maximum(sizes - self.free, 0) / self.sigma
        pull = (fps**2 / self.sigma * beyond / sizes)[..., None] * second
        around = np.diff(np.pad(pull, ((0, 0), (2, 2), (0, 0), (0, 0))), n=2, axis=1)
        energy = np.zeros(toes.shape[:2])
        energy[:, 2 - len(before) :] = 0.5 * np.square(beyond).sum(-1)
        return energy, around[:, len(before) :]


@dataclass(frozen=True)
class FootContact:
    """A toe whose contact bit is set does not travel and is at its rest height, nor does a heel while the foot is flat;
    none goes below it."""

    sigma_speed: float = 0.03
    """Standard deviation of the horizontal speed of a planted toe, m/s."""
    sigma_height: float = 0.01
    """Standard deviation of the height of a planted toe about its rest height, metres."""
    sigma_below: float = 0.005
    """Standard deviation of the depth of any toe below its rest height, metres."""
    heels: HeelSigmas | None = field(default_factory=HeelSigmas)
    """Sigmas of the heels; None leaves them out. They are planted by the toes' contacts and the planned pose."""
    landing: LandingSigmas | None = None
    """Sigmas of the toes' acceleration; None leaves it free, as for motion that was captured."""
    rest_height: float = TOE_REST_HEIGHT
    """Height of the toe joint while the foot is flat on the ground, metres."""
    supports: Float[Tensor, "frames 2"] | None = None
    """Height at which each toe rests in each frame of the window, metres; None: `rest_height`."""
    name: str = "footing"
    unit: str = "m/s"

    def with_sigmas(self, speed: float, height: float, below: float) -> "FootContact":
        """Return the term with these sigmas of toes, `speed` in m/s, `height` and `below` in metres; those of heels
        change in proportion."""
        heels = self.heels and replace(
            self.heels,
            speed=self.heels.speed * speed / self.sigma_speed,
            height=self.heels.height * height / self.sigma_height,
            below=self.heels.below * below / self.sigma_below,
        )
        return replace(self, sigma_speed=speed, sigma_height=height, sigma_below=below, heels=heels)

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies of both feet, nats."""
        above = trial.toe_heights - self._rest_heights
        held = _hold(trial.planted, trial.toe_speeds / self.sigma_speed, above / self.sigma_height)
        energy = (held + 0.5 * (above.clamp(max=0) / self.sigma_below).square()).sum(-1)
        if self.landing is not None:
            beyond = (trial.toe_accelerations - self.landing.free).clamp_min(0) / self.landing.sigma
            energy = energy + 0.5 * beyond.square().sum(-1)
        if self.heels is None:
            return energy
        drops = trial.features.new_tensor(find_heel_drops(trial.skeleton))
        above = trial.heels_world[..., 1] - (self._rest_heights - drops)
        held = _hold(trial.heels_planted, trial.heel_speeds / self.heels.speed, above / self.heels.height)
        held = self.heels.doubt * torch.log1p(held / self.heels.doubt)
        return energy + (held + 0.5 * (above.clamp(max=0) / self.heels.below).square()).sum(-1)

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        toes, resting = list(trial.toes), np.asarray(self._rest_heights)
        before, after = (each[..., toes, :].double().numpy() for each in (trial.before[-2:], trial.joints_world))
        fps, planted = float(trial.fps), trial.planted.numpy()
        sigmas = (self.sigma_speed, self.sigma_height, self.sigma_below)
        energy, slope = _differentiate_contact(before[-1:], after, planted, resting, sigmas, fps)
        if self.landing is not None:
            landing, landing_slope = self.landing.differentiate(before, after, fps)
            energy, slope = energy + landing, slope + landing_slope
        gradient.joints_world[:, :, toes] += slope
        if self.heels is not None:
            before, after = (each.double().numpy() for each in (trial.heels_before[-1:], trial.heels_world))
            sigmas, resting = self.heels.sigmas, resting - find_heel_drops(trial.skeleton)
            planted = trial.heels_planted.numpy()
            heels, slope = _differentiate_contact(before, after, planted, resting, sigmas, fps, self.heels.doubt)
            energy, gradient.heels_world[...] = energy + heels, gradient.heels_world + slope
        return energy

    @property
    def _rest_heights(self) -> float | Float[Tensor, "frames 2"]:
        return self.rest_height if self.supports is None else self.supports

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the horizontal speed of the fastest planted toe or heel, m/s; 0 where none is planted."""
        fastest = (_stays(trial.planted) * trial.toe_speeds).amax(-1)
        if self.heels is None:
            return fastest
        return fastest.maximum((_stays(trial.heels_planted) * trial.heel_speeds).amax(-1))


def _hold(
    planted: Bool[Tensor, "batch steps 2"],
    speeds: Float[Tensor, "batch frames 2"],
    above: Float[Tensor, "batch frames 2"],
) -> Float[Tensor, "batch frames 2"]:
    """Energies of planted points by their speeds and their heights over the floor, in sigmas."""
    return 0.5 * (_stays(planted) * speeds.square() + planted[:, 1:].to(above.dtype) * above.square())


def _stays(planted: Bool[Tensor, "batch steps 2"]) -> Bool[Tensor, "batch frames 2"]:
    """True where a point is planted in a frame and in the one before it, be that before the window."""
    return planted[:, 1:] & planted[:, :-1]


def _differentiate_contact(
    before: Float[np.ndarray, "known 2 3"],
    points: Float[np.ndarray, "batch frames 2 3"],
    planted: Bool[np.ndarray, "batch steps 2"],
    resting: Float[np.ndarray, "*#frames"],
    sigmas: tuple[float, float, float],
    fps: float,
    doubt: float = math.inf,
) -> tuple[Float[np.ndarray, "batch frames"], Float[np.ndarray, "batch frames 2 3"]]:
    """Return the energies of two points, and their gradient; `before` is the frame before the window, if it is known,
    `sigmas` are of speed, height and depth. From `doubt` nats on a contact counts less and less."""
    travel, height, below = (fps / sigmas[0]) ** 2, sigmas[1] ** -2, sigmas[2] ** -2
    above, stands = points[..., 1] - resting, planted[:, 1:]
    sunk, stays = np.minimum(above, 0), stands & planted[:, :-1]
    first = np.broadcast_to(before if len(before) else points[:, :1], (len(points), 1, 2, 3))
    steps = stays[..., None] * np.diff(np.concatenate([first, points], axis=1), axis=1)[..., ::2]
    held = 0.5 * (height * stands * above**2 + travel * (np.square(steps).sum(-1) + 1e-12 * stays))
    share = 1 / (1 + held / doubt)
    energy = 0.5 * below * sunk**2 + (held if math.isinf(doubt) else doubt * np.log1p(held / doubt))
    slope, pull = np.empty_like(points), travel * share[..., None] * steps
    slope[..., 1] = below * sunk + height * share * stands * above
    slope[..., ::2] = -np.diff(pull, axis=1, append=0)
    return energy.sum(-1), slope


@dataclass(frozen=True, eq=False)
class Clearance:
    """Toes that are not planted are the higher over the ground the faster they travel, up to the usual clearance of
    walking people."""

    height: float = 0.035
    """Clearance of a toe in full swing over its rest height, metres: less costs."""
    speed: float = 1.0
    """Speed over the ground from which all of `height` is wanted, m/s; below, in proportion."""
    sigma: float = 0.015
    """Standard deviation of the height that is lacking, metres."""
    rest_height: float | Float[Tensor, "frames 2"] = TOE_REST_HEIGHT
    """Height of the toe joint while the foot is flat on the ground, metres; of each toe's in each frame, if not one."""
    share: Float[Tensor, "frames 2"] | None = None
    """Share of the height that each toe is to clear in each frame of the window, 0 to 1; None: all of it."""
    name: str = "clearance"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies of both toes, nats."""
        return 0.5 * (self._height_deficit(trial) / self.sigma).square().sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the height that the lower toe is lacking, metres; 0 where none is."""
        return self._height_deficit(trial).amax(-1)

    def _height_deficit(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        wanted = self.height * (trial.toe_speeds / self.speed).clamp(max=1)
        if self.share is not None:
            wanted = wanted * self.share.to(wanted)
        lacking = wanted - (trial.toe_heights - self.rest_height)
        return torch.where(trial.contacts, 0.0, lacking.clamp_min(0))
