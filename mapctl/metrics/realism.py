"""Realism without users: the accuracy of a network that separates generated windows from captured ones, and the Frechet
distance of both sets. Each number comes with its floor, one half of the captures against the other.

The distance is that of the Gaussians fitted to the windows' principal components, as the Frechet inception distance
(Heusel et al. 2017, section 2), on standardised joint positions and velocities instead of a network's features.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import scipy
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.runtime.stepwise import Progress
from mapctl.skeleton import CANONICAL

HIPS = CANONICAL.index("hips")
_UPPER_LEGS = CANONICAL.index("leftUpperLeg"), CANONICAL.index("rightUpperLeg")
_LEAST_STD = 1e-3  # floor of a standard deviation, m or m/s, so that joints that hardly move do not decide


WINDOW_FRAMES, _WINDOW_STEP = 30, 10
"""Frames a window, at 30 a second; one more is needed before it for the velocities."""
_BATCH = 64  # windows a step, half from each set
_WIDTH, _DROPOUT = 48, 0.3  # channels of each convolution, and share of its activations that are dropped in training
_LEARNING_RATE, _WEIGHT_DECAY = 1e-3, 1e-2  # of AdamW
_DIMS = 32  # principal components of mocap's windows in which the Frechet distance is taken


@dataclass(frozen=True)
class RealismSettings:
    """Settings of a realism measurement: about 10 s an accuracy on one core at 90 clips."""

    folds: int = 4
    """Number of parts of the clips; each is held out once while a network learns on the others."""
    steps: int = 400
    """Number of optimiser steps of each network, whatever the sets' size. More make a stricter judge."""

    @property
    def min_clips(self) -> int:
        """Number of clips that each set needs, so that half of the mocap still has one for every fold."""
        return 2 * self.folds


@dataclass(frozen=True)
class Realism:
    """How generated motion compares with mocap."""

    accuracy: float
    """Balanced held-out accuracy of the network, generated against mocap, a share: 0.5 is perfect."""
    floor_accuracy: float
    """Balanced held-out accuracy of the network, one half of the mocap's clips against the other, a share likewise."""
    frechet: float
    """Frechet distance of generated windows to mocap's, no unit: coordinates are in mocap's standard deviations."""
    floor_frechet: float
    """Frechet distance between the halves, in the same coordinates; halves are smaller sets, which adds to it."""
    generated_windows: int
    """Number of windows of the generated clips."""
    mocap_windows: int
    """Number of windows of the mocap clips."""


def measure_realism(
    generated: Sequence[Tensor],
    mocap: Sequence[Tensor],
    *,
    generator: torch.Generator,
    settings: RealismSettings = RealismSettings(),
    progress: Progress | None = None,
) -> Realism:
    """Compare clips with mocap, `cut_windows` of each, (windows, frames, channels); half a minute on one core.

    The floor's halves are every other clip of one shuffle that the generator draws: neither style nor length is
    balanced between them, so a small set's floor scatters around 0.5 from seed to seed; it depends on mocap alone.
    Sets should hold the same kinds of motion, or the network learns to separate the kinds. RequestError for fewer
    than 8 clips in a set.
    """
    if min(len(generated), len(mocap)) < settings.min_clips:
        counts = f"got {len(generated)} and {len(mocap)}"
        raise RequestError(f"realism needs at least {settings.min_clips} clips of each, generated and mocap; {counts}")
    seeds = torch.randint(2**62, (2,), generator=generator).tolist()
    shuffled, ours = (torch.Generator().manual_seed(seed) for seed in seeds)
    order = torch.randperm(len(mocap), generator=shuffled).tolist()
    halves = [[mocap[i] for i in half] for half in (order[::2], order[1::2])]
    total = 2 * settings.folds
    done = iter(range(1, total + 1))

    def tick() -> None:
        if progress is not None:
            progress(next(done), total)

    floor, accuracy = (
        compute_held_out_accuracy(*sets, generator=drawn, settings=settings, tick=tick)
        for sets, drawn in ((halves, shuffled), ((generated, mocap), ours))
    )
    basis = Basis.of(torch.cat(list(mocap)), _DIMS)
    points = [basis.project(torch.cat(list(clips))) for clips in (generated, mocap, *halves)]
    frechet, floor_frechet = frechet_distance(*points[:2]), frechet_distance(*points[2:])
    return Realism(accuracy, floor, frechet, floor_frechet, len(points[0]), len(points[1]))


def canonical_positions(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    """Return world positions (metres) of the canonical joints at 30 frames a second; RequestError for unknown rigs."""
    return retarget.to_canonical(motion)[0].resample(PRIOR_FPS).joint_positions()


def facing_angle(positions: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames"]:
    """Return the facing of canonical joints, radians, from positions alone, so that every rig has the same."""
    left, right = _UPPER_LEGS
    return body.facing(positions[:, left], positions[:, right])


def transform_to_ground_frame(
    positions: Float[Tensor, "*batch frames joints 3"],
    ground_xz: Float[Tensor, "*batch #frames 2"],
    angle: Float[Tensor, "*batch #frames"],
) -> Float[Tensor, "*batch frames joints 3"]:
    """Transform world positions into frames on the ground that face by `angle` radians; height stays."""
    return rotations.rotate_about_y(positions - rotations.lift_ground(ground_xz).unsqueeze(-2), -angle.unsqueeze(-1))


def cut_windows(motion: Motion) -> Float[Tensor, "windows frames channels"]:
    """Cut one clip of any known rig and rate into windows, float32: canonical joint positions (m) at 30 frames a
    second, then velocities (m/s) from the frame before each.

    A window is relative to the hips' ground projection and facing in the frame before its first. RequestError for a
    clip shorter than one window, and for rigs that are not known.
    """
    positions, needed = canonical_positions(motion), WINDOW_FRAMES + 1
    if len(positions) < needed:
        raise RequestError(f"{len(positions)} frames at {PRIOR_FPS} fps; a window needs at least {needed}")
    starts = torch.arange(0, len(positions) - WINDOW_FRAMES, _WINDOW_STEP)
    ground, angle = positions[starts, HIPS, ::2], facing_angle(positions)[starts]
    frames = starts[:, None] + torch.arange(needed)
    relative = transform_to_ground_frame(positions[frames], ground.unsqueeze(1), angle.unsqueeze(1))
    velocity = relative.diff(dim=1) * PRIOR_FPS
    return torch.cat([relative[:, 1:].flatten(2), velocity.flatten(2)], dim=-1).float()


@dataclass(frozen=True, eq=False)
class Basis:
    """Principal components of a reference set of windows; both sets of a distance are projected on one basis."""

    mean: Float[Tensor, "features"]
    """Mean of each feature, m or m/s."""
    std: Float[Tensor, "features"]
    """Standard deviation of each feature, m or m/s."""
    axes: Float[Tensor, "features dims"]
    """Orthonormal axes, in units of the standard deviations."""

    @staticmethod
    def of(windows: Float[Tensor, "windows frames channels"], dims: int) -> "Basis":
        """Fit the first `dims` components, fewer of fewer windows, by the smaller of both Gram matrices."""
        flat = windows.flatten(1)
        mean, std = flat.mean(0), flat.std(0, correction=0).clamp_min(_LEAST_STD)
        centred, dims = (flat - mean) / std, min(dims, *flat.shape)
        few = len(centred) < centred.shape[1]
        gram = (centred @ centred.T if few else centred.T @ centred).double().numpy()
        largest = scipy.linalg.eigh(gram, subset_by_index=[len(gram) - dims, len(gram) - 1])[1]
        vectors = torch.from_numpy(largest).to(centred.dtype)
        return Basis(mean, std, torch.nn.functional.normalize(centred.T @ vectors if few else vectors, dim=0))

    def project(self, windows: Float[Tensor, "windows frames channels"]) -> Float[Tensor, "windows dims"]:
        """Project windows to coordinates, float64."""
        return (((windows.flatten(1) - self.mean) / self.std) @ self.axes).double()


def frechet_distance(points: Float[Tensor, "points dims"], reference: Float[Tensor, "others dims"]) -> float:
    """Return |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)) of the points' means and covariances; each set needs two
    points.

    With triangles C = R^T R the root's trace is the sum of the singular values of R1 R2^T, so no matrix root is taken
    and singular covariances (fewer points than dimensions) do no harm.
    """
    first, second = (
        torch.linalg.qr(each - each.mean(0), mode="r").R / (len(each) - 1) ** 0.5 for each in (points, reference)
    )
    apart = (points.mean(0) - reference.mean(0)).square().sum()
    return float(
        apart + first.square().sum() + second.square().sum() - 2 * torch.linalg.svdvals(first @ second.T).sum()
    )


def compute_held_out_accuracy(
    first: Sequence[Float[Tensor, "_ frames channels"]],
    second: Sequence[Float[Tensor, "_ frames channels"]],
    *,
    generator: torch.Generator,
    settings: RealismSettings = RealismSettings(),
    tick: Callable[[], None] = lambda: None,
) -> float:
    """Compute the balanced accuracy, 0 to 1, of networks on clips that their training did not see, mean over folds.

    Each set is a list of clips' windows. Folds are by clip, for windows of one clip overlap; `tick` is called after
    each. The same generator state gives the same bits; torch's global generator and thread count are left as they were.
    RequestError for sets of fewer clips than folds.
    """
    if min(len(first), len(second)) < settings.folds:
        raise RequestError(f"{settings.folds} folds need as many clips in each set, got {len(first)} and {len(second)}")
    sets = [(clips, torch.randperm(len(clips), generator=generator).tolist()) for clips in (first, second)]
    total, threads = 0.0, torch.get_num_threads()
    for fold in range(settings.folds):
        others = [k for k in range(settings.folds) if k != fold]
        training = [torch.cat([clips[i] for k in others for i in order[k :: settings.folds]]) for clips, order in sets]
        held_out = [torch.cat([clips[i] for i in order[fold :: settings.folds]]) for clips, order in sets]
        seed = int(torch.randint(2**62, (1,), generator=generator))
        with torch.random.fork_rng(devices=[]):  # weights and dropout draw from torch's global generator
            torch.default_generator.manual_seed(seed)
            torch.set_num_threads(1)
            try:
                classify = _train_network(training, settings)
                with torch.no_grad():
                    ours, theirs = (torch.cat([classify(part) for part in each.split(512)]) for each in held_out)
            finally:
                torch.set_num_threads(threads)
        total += float(((ours > 0).double().mean() + (theirs <= 0).double().mean()) / 2)
        tick()
    return total / settings.folds


def _train_network(
    sets: Sequence[Float[Tensor, "_ frames channels"]], settings: RealismSettings
) -> Callable[[Float[Tensor, "_ frames channels"]], Float[Tensor, " _"]]:
    """Train three convolutions over time, their mean over frames, and one logit: positive for the first set."""
    windows = torch.cat(list(sets))
    mean, std = windows.mean((0, 1)), windows.std((0, 1), correction=0).clamp_min(_LEAST_STD)
    layers: list[nn.Module] = []
    channels = windows.shape[-1]
    for stride in (1, 2, 2):
        layers += [nn.Conv1d(channels, _WIDTH, 5, stride, padding=2), nn.LeakyReLU(0.2)]
        layers.append(nn.Dropout(_DROPOUT))
        channels = _WIDTH
    network = nn.Sequential(*layers, nn.AdaptiveAvgPool1d(1), nn.Flatten(), nn.Linear(channels, 1), nn.Flatten(0))
    optimiser = torch.optim.AdamW(network.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    half = _BATCH // 2
    target = torch.cat([torch.ones(half), torch.zeros(half)])

    def classify(part: Tensor) -> Tensor:
        return network(((part - mean) / std).transpose(1, 2))

    for _ in range(settings.steps):
        batch = torch.cat([windows[torch.randint(len(windows), (half,))] for windows in sets])
        loss = nn.functional.binary_cross_entropy_with_logits(classify(batch), target)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    network.eval()
    return classify


class Diversity(NamedTuple):
    """Average pairwise distance of samples."""

    world_cm: float
    """Distance between the joints in the world, centimetres: of trajectories and poses."""
    root_aligned_cm: float
    """Distance between the joints relative to the hips and facing of each frame, centimetres: of poses and timing."""


def measure_diversity(samples: Sequence[Motion]) -> Diversity:
    """Measure diversity of samples from one start (any known rig); RequestError for fewer than two of one length."""
    lengths = sorted({sample.num_frames / sample.fps for sample in samples})
    if len(samples) < 2 or len(lengths) > 1:
        shown = " and ".join(f"{float(length):.4g}" for length in lengths)
        raise RequestError(f"diversity needs at least 2 samples of one length, got {len(samples)} of {shown} s")
    positions = torch.stack([canonical_positions(sample) for sample in samples])
    aligned = [transform_to_ground_frame(each, each[:, HIPS, ::2], facing_angle(each)) for each in positions]
    relative = torch.stack([each - each[:, HIPS : HIPS + 1] for each in aligned])
    # Frame by frame, for the distances of a thousand samples at once would need gigabytes.
    sums = (sum(float(torch.cdist(at, at).sum()) for at in one.permute(1, 2, 0, 3)) for one in (positions, relative))
    count, frames, joints, _ = positions.shape
    return Diversity(*(100.0 * (total / (count * (count - 1) * frames * joints)) for total in sums))
