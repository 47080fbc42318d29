"""Spoilt copies of clean motion, as captures come: tremble, spikes, joints and limbs that are lost, moments without
anything. How much of each is drawn anew for every window, and the network is told the noise as a file's would be.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import GroundPose
from mapctl.pose import BodyPose
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL
from priors.training.augmentation.draws import Draws

_JOINTS = CANONICAL.num_joints


@dataclass(frozen=True)
class CorruptionSettings:
    """Ranges that are drawn from, for each window."""

    angle_deg: tuple[float, float] = (0.3, 10.0)
    """Noise of each of a joint's three angles, log-uniform."""
    root_cm: tuple[float, float] = (0.2, 6.0)
    """Noise of each coordinate of the hips, log-uniform."""
    clean: float = 0.1
    """Share of windows whose angles, and share whose hips, have no noise."""
    uneven: float = 0.5
    """Spread (of the logarithm) of the noise among joints, in half of the windows."""
    markers: float = 0.15
    """Share of windows whose noise is that of the joints' positions: the shorter a bone, the more it turns."""
    marker_cm: tuple[float, float] = (0.5, 6.0)
    """Noise of the joints' positions, log-uniform."""
    correlated: float = 0.2
    """Share of windows whose noise lasts beyond a frame."""
    spikes: float = 0.02
    """Largest share of an angle's frames that are spikes, in half of the windows."""
    spike_deg: tuple[float, float] = (15.0, 60.0)
    """Height of the spikes."""
    found: float = 0.8
    """Share of the spikes that are taken for what they are, and masked."""
    dropout: float = 0.4
    """Largest share of a joint's frames that are lost, in a quarter of the windows."""
    limb: float = 0.25
    """Share of windows that lose a limb for a while."""
    gap: float = 0.1
    """Share of windows that lose everything for a while."""
    told: float = 0.2
    """Error (of the logarithm) of the noise level that the network is given."""
    size: float = 0.05
    """Spread of a performer's size: of the logarithm of the distance that the hips travel."""


def make_clean_capture(features: Float[Tensor, "batch frames size"]) -> Capture:
    """The features as a perfect capture, from the origin."""
    batch, frames = features.shape[:2]
    origin = GroundPose(features.new_zeros(batch, 2), features.new_zeros(batch))
    pose = BodyPose.of_features(features, origin)
    return Capture(
        pose.root_position,
        pose.local_quat_xyzw[..., 0, :],
        pose.joint_rotvec,
        torch.ones(batch, frames, dtype=torch.bool),
        torch.ones(batch, frames, _JOINTS, dtype=torch.bool),
        torch.zeros(batch),
        torch.zeros(batch, _JOINTS),
    )


def corrupt(clean: Capture, settings: CorruptionSettings, generator: torch.Generator) -> Capture:
    """A spoilt copy; what is masked keeps its values, which nobody should look at."""
    draw = Draws(generator, *clean.root.shape[:2])
    sigma, sigma_root = _sample_sigmas(settings, draw)
    angles, spiky = _sample_angles(sigma, settings, draw)
    quats = torch.cat([clean.hips[:, :, None], rotations.from_rotation_vector(clean.joints)], dim=2)
    quats = rotations.multiply(quats, rotations.from_rotation_vector(angles))
    lost, nothing = _sample_missing(settings, draw)
    found = spiky & (draw.uniform(draw.frames, _JOINTS) < settings.found)
    error = torch.exp(settings.told * draw.normal(_JOINTS + 1))
    return Capture(
        clean.root + draw.normal(draw.frames, 3) * sigma_root[:, None, None],
        quats[:, :, 0],
        rotations.to_rotation_vector(quats[:, :, 1:]),
        ~nothing,
        ~(lost | found | nothing[..., None]),
        sigma_root * error[:, -1],
        sigma * error[:, :-1],
    )


_MAX_NOISE_RAD = 0.6  # radians of noise; more is no noise but another motion


def _bone_lengths() -> Float[Tensor, " joints"]:
    """From each canonical joint to the next, metres; of the last ones, the bone before."""
    lengths = CANONICAL.offsets.norm(dim=-1).float()
    return torch.stack(
        [lengths[below[0]] if (below := CANONICAL.children(joint)) else lengths[joint] for joint in range(_JOINTS)]
    )


def _sample_sigmas(settings: CorruptionSettings, draw: Draws) -> tuple[Tensor, Tensor]:
    """By joint, radians (batch, joints), and of the hips' position, metres (batch,)."""
    angle = torch.deg2rad(draw.log_uniform(*settings.angle_deg, 1)) * (draw.uniform(1) > settings.clean)
    uneven = torch.where(draw.uniform(1) < 0.5, settings.uneven, 0.0) * draw.normal(_JOINTS)
    root = draw.log_uniform(*settings.root_cm) / 100 * (draw.uniform() > settings.clean)
    place = draw.log_uniform(*settings.marker_cm, 1) / 100
    of_places = (place / _bone_lengths()).clamp(max=_MAX_NOISE_RAD)
    marked = draw.uniform(1) < settings.markers
    return torch.where(marked, of_places, angle * torch.exp(uneven)), torch.where(marked[:, 0], place[:, 0], root)


def _sample_angles(
    sigma: Tensor, settings: CorruptionSettings, draw: Draws
) -> tuple[Float[Tensor, "batch frames joints 3"], Tensor]:
    """Rotation vectors to add, and which joints a spike has hit (batch, frames, joints).

    Noise is added to a rig's three channels, whose axes are square at best: near gimbal lock two of them are one.
    """
    noise = draw.normal(draw.frames, _JOINTS, 3)
    stays = torch.where(draw.uniform() < settings.correlated, 0.8 * draw.uniform(), 0.0)
    noise = _correlate_in_time(noise, stays) * sigma[:, None, :, None]
    share = settings.spikes * draw.uniform() * (draw.uniform() < 0.5)
    hit = draw.uniform(draw.frames, _JOINTS, 3) < share[:, None, None, None]
    low, high = settings.spike_deg
    height = torch.deg2rad(low + (high - low) * draw.uniform(1, 1, 1))
    noise = noise + hit * height * torch.sign(draw.normal(draw.frames, _JOINTS, 3))
    skewed = torch.nn.functional.normalize(draw.normal(_JOINTS, 3, 3), dim=-1)
    square = torch.linalg.qr(draw.normal(_JOINTS, 3, 3))[0]
    axes = torch.where(draw.uniform(1, 1, 1) < 0.5, square, skewed)
    return torch.einsum("btjk,bjkc->btjc", noise, axes), hit.any(dim=-1)


def _correlate_in_time(noise: Float[Tensor, "batch frames joints 3"], stays: Float[Tensor, " batch"]) -> Tensor:
    """Noise of the same spread, of which the share `stays` comes from the frame before."""
    if not stays.any():
        return noise
    kept, fresh = stays[:, None, None], torch.sqrt(1 - stays.square())[:, None, None]
    out = [noise[:, 0]]
    for frame in range(1, noise.shape[1]):
        out.append(kept * out[-1] + fresh * noise[:, frame])
    return torch.stack(out, dim=1)


def _sample_missing(settings: CorruptionSettings, draw: Draws) -> tuple[Tensor, Tensor]:
    """Which joints are lost (batch, frames, joints), and in which frames all are (batch, frames)."""
    share = settings.dropout * draw.uniform(1, 1) * (draw.uniform(1, 1) < 0.25)
    lost = draw.uniform(draw.frames, _JOINTS) < share
    limb = draw.limb()
    during = _sample_interval(10, draw.frames, draw) & (draw.uniform(1) < settings.limb)
    nothing = _sample_interval(3, draw.frames // 3, draw) & (draw.uniform(1) < settings.gap)
    return lost | (limb[:, None] & during[..., None]), nothing


def _sample_interval(shortest: int, longest: int, draw: Draws) -> Tensor:
    """One run of true frames in each window (batch, frames), never all of them."""
    shortest, longest = min(shortest, draw.frames - 1), min(longest, draw.frames - 1)
    length = shortest + draw.below(torch.full((draw.batch,), longest - shortest + 1))
    return draw.mark(draw.below(draw.frames - length + 1), length)
