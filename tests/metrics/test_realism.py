"""Realism measures: windows and distances against formulas written out anew, the classifier on sets that are known."""

import numpy as np
import pytest
import scipy.linalg
import torch
from captures import trembling
from helpers import bandai_skeleton, generator, moved, walk

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.metrics import gait, realism
from mapctl.metrics.realism import measure_diversity
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

QUICK = realism.RealismSettings(steps=60)


def clip_set(count: int, frames: int = 61, *, seed: int = 0) -> list[Motion]:
    """Different walks; sets of different seeds share no clip and are drawn alike."""
    drawn = torch.rand(count, 2, generator=generator(seed)).tolist()
    return [
        walk(frames, turn_rate=0.6 * turn - 0.3, cadence=0.7 + 0.4 * cadence, seed=1000 * seed + k)
        for k, (turn, cadence) in enumerate(drawn)
    ]


def windows_of(motions):
    return [realism.cut_windows(motion) for motion in motions]


def test_windows_are_positions_from_the_first_frame_and_velocities():
    clip = walk(75, turn_rate=0.4)
    positions = clip.joint_positions().numpy()
    left, right = (positions[:, CANONICAL.index(f"{side}UpperLeg")] for side in ("left", "right"))
    got = realism.cut_windows(clip).numpy()
    assert got.shape == (5, 30, 2 * 3 * 21)
    for number, start in enumerate(range(0, 45, 10)):
        across = left[start] - right[start]
        side = np.array([across[0], 0, across[2]]) / np.hypot(across[0], across[2])
        axes = np.stack([side, [0, 1, 0], np.cross(side, [0, 1, 0])])
        ground = positions[start, 0] * [1, 0, 1]
        seen = (positions[start : start + 31] - ground) @ axes.T
        expected = np.concatenate([seen[1:], np.diff(seen, axis=0) * 30], axis=1).reshape(30, -1)
        np.testing.assert_allclose(got[number], expected, atol=1e-5)


def test_windows_of_any_known_rig_and_rate_are_the_same():
    """A constant walk, for whose straight pieces resampling loses nothing that the tolerance would miss."""
    clip = walk(61)
    other_rig = retarget.from_canonical(clip, retarget.identify_rig(bandai_skeleton()))
    same, on_rig, slower = windows_of([clip, other_rig, clip.resample(60)])
    torch.testing.assert_close(on_rig, same, atol=1e-4, rtol=0)
    torch.testing.assert_close(slower, same, atol=1e-4, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_frechet_distance_is_the_formula(seed):
    rng = np.random.default_rng(seed)
    first = rng.normal(size=(60, 5)) @ rng.normal(size=(5, 5)) + rng.normal(size=5)
    second = rng.normal(size=(80, 5)) @ rng.normal(size=(5, 5))
    root = scipy.linalg.sqrtm(np.cov(first.T) @ np.cov(second.T)).real
    apart = ((first.mean(0) - second.mean(0)) ** 2).sum()
    expected = apart + np.trace(np.cov(first.T) + np.cov(second.T) - 2 * root)
    got = realism.frechet_distance(torch.from_numpy(first), torch.from_numpy(second))
    assert got == pytest.approx(expected, rel=1e-9)
    assert got == pytest.approx(realism.frechet_distance(torch.from_numpy(second), torch.from_numpy(first)), rel=1e-9)


def test_frechet_distance_of_a_shift_is_its_square_even_where_covariances_are_singular():
    """Four points in twenty dimensions, where the covariances' product has no real root by the textbook."""
    points = torch.randn(4, 20, generator=generator(1), dtype=torch.float64)
    assert realism.frechet_distance(points, points) == pytest.approx(0, abs=1e-12)
    assert realism.frechet_distance(points + 0.5, points) == pytest.approx(20 * 0.25, rel=1e-12)


@pytest.mark.slow
def test_two_sets_of_one_kind_are_indistinguishable_and_trembling_is_not():
    mocap, alike = clip_set(24), clip_set(24, seed=1)
    shaky = [trembling(clip, 0.03, seed=k) for k, clip in enumerate(alike)]
    same, other = (
        realism.measure_realism(windows_of(result), windows_of(mocap), generator=generator(4), settings=QUICK)
        for result in (alike, shaky)
    )
    assert 0.2 < same.accuracy < 0.8
    assert 0.2 < same.floor_accuracy < 0.8
    assert other.accuracy > 0.9
    assert other.frechet > same.frechet
    assert (other.floor_accuracy, other.floor_frechet) == (same.floor_accuracy, same.floor_frechet)
    assert (same.generated_windows, same.mocap_windows) == (24 * 4, 24 * 4)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_leaves_torch_alone():
    first, second = windows_of(clip_set(4)), windows_of(clip_set(4, seed=1))
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    threads = torch.get_num_threads()
    score = realism.compute_held_out_accuracy(first, second, generator=generator(5), settings=QUICK)
    assert torch.equal(torch.rand(3), expected)
    assert torch.get_num_threads() == threads
    torch.rand(5)  # another state of the global generator
    assert realism.compute_held_out_accuracy(first, second, generator=generator(5), settings=QUICK) == score


@pytest.mark.slow
def test_too_few_or_too_short_clips_are_refused():
    clips = windows_of(clip_set(8, 31))
    with pytest.raises(RequestError, match="at least 8 clips of each, generated and mocap; got 7 and 8"):
        realism.measure_realism(clips[:7], clips, generator=generator())
    with pytest.raises(RequestError, match="20 frames"):
        realism.cut_windows(walk(20))
    with pytest.raises(RequestError, match="4 folds"):
        realism.compute_held_out_accuracy(clips[:3], clips, generator=generator())


def test_diversity_parts_places_from_poses():
    """Copies that stand apart differ in the world alone; joints that swing otherwise differ in both."""
    clip = walk(45)
    apart = measure_diversity([clip, moved(clip, turn=0.0, shift=(0.3, 0.4))])
    assert apart.world_cm == pytest.approx(50, rel=1e-6)
    assert apart.root_aligned_cm == pytest.approx(0, abs=1e-4)
    turned = measure_diversity([clip, moved(clip, turn=1.0, shift=(0.0, 0.0))])
    assert turned.world_cm > 10
    assert turned.root_aligned_cm == pytest.approx(0, abs=1e-4)
    assert measure_diversity([clip, walk(45, seed=5)]).root_aligned_cm > 0.5


def test_step_lengths_go_from_foot_to_other_foot():
    planted = torch.zeros(60, 2, dtype=torch.bool)
    for foot, start, stop in ((0, 5, 12), (1, 14, 20), (1, 22, 26), (0, 28, 33), (1, 59, 60)):
        planted[start:stop, foot] = True
    toes = torch.zeros(60, 2, 2, dtype=torch.float64)
    toes[14, 1], toes[22, 1], toes[28, 0] = (torch.tensor(at).double() for at in ([0.3, 0.4], [0.0, 1.0], [0.0, 1.7]))
    lengths = gait.step_lengths(toes, planted, 30.0)
    given = {int(frame): float(lengths[frame]) for frame in (~lengths.isnan()).nonzero()[:, 0]}
    # 22 sets the same foot down again; 59 is a second and more after the touch-down before it
    assert given == pytest.approx({14: 0.5, 28: 0.7})
