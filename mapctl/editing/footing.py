"""Footing: planted toes are held still and on the floor by the legs, and nothing else changes."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts
from mapctl.contacts import compute_rest_log_probability, fit_supports
from mapctl.editing.rigged_motion import RiggedMotion, place_ankles
from mapctl.editing.travel import GroundTransform, move_by_share, repeat_over_ground
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.retarget.rigs import Rig

_MEDIAN_OF_NORMAL = 0.6745  # of the size of a normal variable, in standard deviations
_NOISE_FRAMES = 12  # frames from which noise is estimated
_NOISE_SPEED = 0.04  # m/s that noise of toes makes once they are smoothed, before contacts are looked for
_SMOOTH_SECONDS = (0.04, 0.15)  # least and greatest standard deviation of that Gaussian
_MERGE_SECONDS, _MERGE_METRES = 0.15, 0.06  # contacts at one position with less than these between them are one
_ROLL_METRES = 0.005  # over its usual height in a contact, from which a planted toe is on its way down or up
_FADE_SECONDS = 0.12  # over which a foot comes to its position and leaves it: a swing foot is moved as little as that


def plant_feet(motion: Motion, rig: Rig | None = None, cycle: GroundTransform | None = None) -> Motion:
    """Hold planted toes still and on the floor, on the motion's own rig at its own rate.

    A toe is planted where it rests and carries the body (see `mapctl.contacts`), noise smoothed away; then it
    stays where it is on average during that contact, at the height of its support. Thighs and shins bring it there,
    feet keep their orientation, and hips go down where a leg is too short. All other local rotations stay to the bit.
    `cycle` is the travel of a loop, which stays one. `rig` wins over what would be recognised; RequestError where the
    rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    if cycle is None:
        return rigged.with_motion(_plant(rigged)).in_file_world(motion)
    frames = motion.num_frames
    around = rigged.with_motion(repeat_over_ground(rigged.motion, cycle, 3))
    middle = _plant(around).slice(frames, 2 * frames)
    planted = move_by_share(middle, cycle, -torch.ones(frames, dtype=torch.float64))
    return rigged.with_motion(planted).in_file_world(motion)


def _plant(rigged: RiggedMotion) -> Motion:
    toes, fps = rigged.positions("Toes"), float(rigged.motion.fps)
    planted = find_contacts(toes, rigged.position("hips"), fps)
    if not bool(planted.any()):
        return rigged.motion
    corrections = correct_toes(toes, toes, planted, fps)
    corrections[..., 1] = _correct_heights(toes, planted, fps)
    return place_ankles(rigged, rigged.positions("Foot") + corrections)


def find_contacts(
    toes: Float[Tensor, "frames 2 3"], hips: Float[Tensor, "frames 3"], fps: float
) -> Bool[Tensor, "frames 2"]:
    """Find in which frames each toe is planted; contacts that noise alone parts are one. Positions in metres."""
    sigma = _choose_smoothing(toes, fps)
    smooth = _smooth(toes, sigma)
    noise = torch.tensor([[_NOISE_SPEED]])
    resting = compute_rest_log_probability(smooth, hips, fps, noise)
    if sigma <= _SMOOTH_SECONDS[0] * fps:  # hardly any noise: what is seen as it is counts too
        resting = resting.maximum(compute_rest_log_probability(toes, hips, fps, noise))
    shortest = max(1, round(contacts.ContactSettings().shortest * fps))
    planted = contacts.remove_short_runs(resting > math.log(0.5), shortest)
    for foot, start, stop in list(true_intervals(~planted)):
        inside = start > 0 and stop < len(planted)
        if inside and stop - start < _MERGE_SECONDS * fps:
            apart = (smooth[start - 1, foot] - smooth[stop, foot])[::2].norm()
            planted[start:stop, foot] |= bool(apart < _MERGE_METRES)
    return planted


def correct_toes(
    toes: Float[Tensor, "frames 2 3"], drift: Float[Tensor, "frames 2 3"], planted: Bool[Tensor, "frames 2"], fps: float
) -> Float[Tensor, "frames 2 3"]:
    """Return corrections of toe positions, metres, that take the drift out of each contact but for its mean, and are
    smooth between contacts. Drift equal to the positions leaves toes quite still."""
    corrections = torch.zeros_like(toes)
    for foot, start, stop in true_intervals(planted):
        own = drift[start:stop, foot]
        corrections[start:stop, foot] = own.mean(dim=0) - own
    return _interpolate(corrections, planted, fps)


def _correct_heights(
    toes: Float[Tensor, "frames 2 3"], planted: Bool[Tensor, "frames 2"], fps: float
) -> Float[Tensor, "frames 2"]:
    """Return corrections that put planted toes at the height of their support, and let no toe go lower. The ends of a
    contact, in which a toe is on its way down or up, are left to what is between."""
    smooth = _smooth(toes, _choose_smoothing(toes, fps))
    rest, heights, smooth = fit_supports(smooth, planted), toes[..., 1], smooth[..., 1]
    firm = heights < rest
    for foot, start, stop in true_intervals(planted):
        usual = smooth[start:stop, foot].median()
        firm[start:stop, foot] |= smooth[start:stop, foot] < usual + _ROLL_METRES
    return _interpolate(torch.where(firm, rest - heights, 0.0)[..., None], firm, fps)[..., 0]


def _choose_smoothing(toes: Float[Tensor, "frames 2 3"], fps: float) -> float:
    """Choose the standard deviation in frames of the Gaussian that leaves so little of the noise.

    Noise is told by third differences, of which white noise of 1 makes 20 in the square; most frames have little else.
    Of it a Gaussian of s frames leaves velocities of (4 sqrt(pi) s^3)^-1/2 a frame.
    """
    least, most = (seconds * fps for seconds in _SMOOTH_SECONDS)
    if len(toes) < _NOISE_FRAMES:
        return least
    sizes = toes[..., ::2].diff(n=3, dim=0).abs().flatten()
    noise = float(sizes.median()) / _MEDIAN_OF_NORMAL / math.sqrt(20)
    wanted = ((noise * fps / _NOISE_SPEED) ** 2 / (4 * math.sqrt(math.pi))) ** (1 / 3)
    return min(max(wanted, least), most)


def _smooth(values: Float[Tensor, "frames *width"], sigma: float) -> Float[Tensor, "frames *width"]:
    """Smooth values by a Gaussian of `sigma` frames."""
    return gaussian.convolve(values, gaussian.kernel(max(sigma, 1e-6), side=max(1, round(3 * sigma))), "repeated")


def _interpolate(
    corrections: Float[Tensor, "frames 2 width"], firm: Bool[Tensor, "frames 2"], fps: float
) -> Float[Tensor, "frames 2 width"]:
    return torch.stack(
        [
            interpolate_offsets(corrections[:, foot], firm[:, foot], seconds=_FADE_SECONDS, fps=fps)
            for foot in range(corrections.shape[1])
        ],
        dim=1,
    )
