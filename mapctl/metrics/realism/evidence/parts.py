"""Windows as sums of parts, by joint and band of frequency: any can be exchanged while the rest stays as it is.

Velocities are derived after an exchange, so that positions and velocities of what comes out agree.
"""

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.metrics.realism.windows import HIPS, WindowSettings, find_window_frames
from mapctl.skeleton import CANONICAL

EDGES_HZ = (1.0, 3.0, 6.0, 10.0)
"""Where bands of frequency meet, Hz; the last one ends at half the frame rate."""
BANDS = ("travel", "mean pose", "0-1 Hz", "1-3 Hz", "3-6 Hz", "6-10 Hz", "10-15 Hz")
"""Parts of a window in time: the straight line of the hips' mean velocity over the ground; the mean of what is left;
and what changes about both, by frequency."""
JOINTS = CANONICAL.names
"""Parts of a window in space: a joint stands for its place from the joint above it, the hips for theirs in the world,
so that what is above a joint is carried along when it is exchanged."""

_CROSSOVER = 0.1  # half of the width over which one band gives way to the next, as a share of the frequency
_PAD = 30  # frames by which a clip is extended at each end before it is parted


def _find_ancestors() -> Float[Tensor, "joints joints"]:
    """Return a matrix of which row j is 1 at joint j and at all above it: it sums bones to positions."""
    rows = torch.eye(CANONICAL.num_joints, dtype=torch.float64)
    for joint, parent in enumerate(CANONICAL.parents):
        if parent >= 0:
            rows[joint] += rows[parent]
    return rows


ANCESTORS = _find_ancestors()
"""Matrix that takes bones, each from the joint above, to positions."""


def split_frequencies(signal: Float[Tensor, "frames *width"], fps: float) -> Float[Tensor, "bands frames *width"]:
    """Split a signal into the bands between EDGES_HZ, which add up to it; the lowest holds the mean and the trend.

    A cosine transform of the whole signal without the line between its ends, which is first extended by a second of
    itself turned about either end, so that neither value nor slope jumps there. Bands give way to each other by raised
    cosines over 10 % of the frequency on either side.
    """
    width = signal.shape[1:]
    values = signal.detach().double().flatten(1).numpy()
    pad = min(_PAD, len(values) - 1)
    longer = torch.from_numpy(values)
    before, after = 2 * longer[:1] - longer[1 : pad + 1].flip(0), 2 * longer[-1:] - longer[-pad - 1 : -1].flip(0)
    longer = torch.cat([before, longer, after])
    share = torch.linspace(0, 1, len(longer), dtype=torch.float64)[:, None]
    line = torch.lerp(longer[:1], longer[-1:], share)
    spectrum = torch.from_numpy(scipy.fft.dct((longer - line).numpy(), axis=0, norm="ortho"))
    frequency = torch.arange(len(longer), dtype=torch.float64) * fps / (2 * len(longer))
    passed = torch.stack([_pass_below(frequency, edge) for edge in EDGES_HZ])
    nothing, everything = torch.zeros_like(passed[:1]), torch.ones_like(passed[:1])
    gains = torch.cat([nothing, passed, everything]).diff(dim=0)
    bands = torch.from_numpy(scipy.fft.idct((gains[..., None] * spectrum).numpy(), axis=1, norm="ortho"))
    bands[0] += line
    return bands[:, pad : pad + len(values)].unflatten(-1, width)


def _pass_below(frequency: Float[Tensor, " bins"], edge: float) -> Float[Tensor, " bins"]:
    """Return the gain of a low-pass filter: 1 below the edge, 0 above, half a cosine in between."""
    share = ((frequency / edge - (1 - _CROSSOVER)) / (2 * _CROSSOVER)).clamp(0, 1)
    return 0.5 + 0.5 * torch.cos(torch.pi * share)


def cut_parts(
    positions: Float[Tensor, "clip_frames joints 3"], settings: WindowSettings
) -> Float[Tensor, "windows bands frames_and_one joints 3"]:
    """Cut one clip into the windows of `cut_windows`, each as parts by BANDS and JOINTS, metres, float32.

    The first frame is the one before the window. `join_parts` of the sum gives the windows' channels. The clip is split
    by frequency as a whole: a second alone holds too few cycles to tell slow change from a trend. RequestError for a
    clip shorter than a window.
    """
    frames, ground, angle = find_window_frames(positions, settings)
    bands = split_frequencies(_to_bones(positions), PRIOR_FPS)[:, frames].transpose(0, 1)  # windows first
    bands[:, 0, :, HIPS] -= rotations.lift_ground(ground)
    bands = rotations.rotate_about_y(bands, -angle[:, :, None, None])
    lowest = bands[:, :1].clone()
    travel = torch.zeros_like(lowest)
    line = (lowest[:, :, -1:, HIPS, ::2] - lowest[:, :, :1, HIPS, ::2]) * torch.linspace(
        0, 1, lowest.shape[2], dtype=lowest.dtype
    ).unsqueeze(-1)
    travel[..., HIPS, ::2] = line
    mean = (lowest - travel).mean(dim=2, keepdim=True).expand_as(lowest)
    return torch.cat([travel, mean, lowest - travel - mean, bands[:, 1:]], dim=1).float()


def _to_bones(positions: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames joints 3"]:
    """Return each joint's place from the joint above it; the root's own."""
    parents = torch.tensor([max(parent, 0) for parent in CANONICAL.parents])
    bones = positions - positions[:, parents]
    bones[:, HIPS] = positions[:, HIPS]
    return bones


def join_parts(bones: Float[Tensor, "*batch frames_and_one joints 3"]) -> Float[Tensor, "*batch frames channels"]:
    """Return the channels of windows, as `cut_windows` gives them, from bones: their positions (m), then velocities."""
    positions = torch.einsum("jk,...kc->...jc", ANCESTORS.to(bones), bones)
    velocity = positions.diff(dim=-3) * PRIOR_FPS
    return torch.cat([positions[..., 1:, :, :].flatten(-2), velocity.flatten(-2)], dim=-1)


def join_bone(bone: Float[Tensor, "*batch frames_and_one 3"]) -> Float[Tensor, "*batch frames 6"]:
    """Return the channels of one joint alone: its place from the joint above it (m), and its velocity from there."""
    return torch.cat([bone[..., 1:, :], bone.diff(dim=-2) * PRIOR_FPS], dim=-1)


def pull_back(
    gradient: Float[Tensor, "*batch frames channels"],
) -> tuple[Float[Tensor, "*batch frames joints 3"], Float[Tensor, "*batch frames joints 3"]]:
    """Pull a gradient by channels back to bones: by their places, and by their velocities (per m/s)."""
    place, velocity = gradient.unflatten(-1, (2, len(JOINTS), 3)).unbind(dim=-3)
    back = ANCESTORS.to(gradient)
    return torch.einsum("jk,...jc->...kc", back, place), torch.einsum("jk,...jc->...kc", back, velocity)
