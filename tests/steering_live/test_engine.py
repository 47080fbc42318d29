"""Steering held by an engine: saved and rolled back, forked, warm, at any frame rate, and checked at its edge."""

import copy
import math
import multiprocessing
import pickle
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import generator
from tiny_prior import save_tiny_prior
from tiny_steering import AHEAD, DENSITY, QUICK, begun
from tiny_stitcher import tiny_stitcher

import priors
from controllers.steering import steer
from controllers.steering.arrival import Arriver
from controllers.steering.loop import Playback
from mapctl.errors import RequestError
from mapctl.intent.steering import Arrival, Command
from mapctl.skeleton import CANONICAL, Skeleton

ARRIVER = Arriver(tiny_stitcher())
GOING = replace(AHEAD, arrival=Arrival((0.5, 0.4), 0.8))
LARGE = Skeleton(CANONICAL.names, CANONICAL.parents, 1.3 * CANONICAL.offsets)


def played(state, command, steps, stepper=ARRIVER):
    """The state after so many steps, and their frames."""
    found = []
    for _ in range(steps):
        state, frames = stepper(state, command)
        found.append(frames)
    return state, found


def bits(pieces):
    """All that a step delivers, as one row."""
    motions = [motion for piece in pieces for motion in (piece.motion, piece.ahead) if motion is not None]
    parts = [part for motion in motions for part in (motion.root_position, motion.local_quat_xyzw)]
    return torch.cat([part.flatten() for part in [*parts, *(piece.root_velocity for piece in pieces)]])


@pytest.mark.parametrize(
    ("command", "skeleton"),
    [
        (AHEAD, LARGE),
        (replace(AHEAD, reach={"leftHand": (0.4, 1.2, 0.6)}, look_at=(1.0, 1.0, 2.0)), CANONICAL),
        (GOING, CANONICAL),  # saved while the approach is computed
    ],
)
def test_a_state_that_was_saved_goes_on_to_the_bit(command, skeleton):
    state, _ = steer.begin(DENSITY, AHEAD, generator=generator(), settings=QUICK, skeleton=skeleton)
    state, _ = played(played(state, AHEAD, 1)[0], command, 1)
    saved = steer.save(state)
    assert len(saved) < 50_000
    copies = [steer.restore(saved, DENSITY), pickle.loads(pickle.dumps(state)), copy.deepcopy(state)]  # noqa: S301
    again = command if command.arrival is None else replace(command, arrival=replace(command.arrival))
    expected = bits(played(state, command, 3)[1])
    for other in copies:
        assert torch.equal(bits(played(other, again, 3)[1]), expected)


def test_the_same_order_in_another_command_is_no_new_order():
    pose = begun()[1].motion
    order = Arrival((0.5, 0.4), 0.8, pose=pose)
    assert order == replace(order, pose=replace(pose))
    assert order not in (replace(order, pose=None), replace(order, by=0.9), replace(order, pose=pose.mirror()))


def _multiply_and_step(state):
    _ = torch.randn(600, 600) @ torch.randn(600, 600)  # as a prior of full size does, on all threads that there are
    return bits(played(state, AHEAD, 2)[1]).numpy()


@pytest.mark.skipif(sys.platform != "linux", reason="only here a process forks safely")
def test_a_forked_pool_steps_after_its_parent_has_solved():
    state, threads = begun()[0], torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        expected = _multiply_and_step(state)
        with multiprocessing.get_context("fork").Pool(1) as pool:
            found = pool.apply_async(_multiply_and_step, (state,)).get(timeout=60)
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(found, expected)


_WARM = """
import gc
import math
from numba.core.dispatcher import Dispatcher
from dataclasses import replace
from tiny_steering import AHEAD, begun
from controllers.steering import steer

def compiled():
    return sum(len(each.overloads) for each in gc.get_objects() if isinstance(each, Dispatcher))

state, _ = begun()
cold = compiled()
steer.warm_up(state, [AHEAD])
warm = compiled()
backward = replace(AHEAD, heading=math.pi, facing=0.0)
for command in (AHEAD, backward, replace(AHEAD, step_length=0.5), replace(AHEAD, reach={"leftHand": (0.4, 1.2, 0.6)})):
    steer.step(state, command)
print(warm - cold, compiled() - warm)
"""


@pytest.mark.slow
def test_nothing_is_compiled_or_loaded_after_a_warm_up():
    here = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", _WARM], cwd=here, capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert (before > 0, after) == (True, 0)


def test_poses_at_60_hz_lie_between_frames_then_on_the_forecast_and_stand_at_its_end():
    playback, (state, first) = Playback(), begun()
    with pytest.raises(RequestError, match="nothing was shown"):
        playback.at(0.0)
    playback.show(first, 0.0)
    for _ in range(3):
        due, (state, frames) = state.frames / 30, steer.step(state, AHEAD)
        playback.show(frames, due)
    roots = [playback.at(k / 60).root_position[0] for k in range(40)]
    assert torch.equal(roots[18], frames.motion.root_position[-1])
    torch.testing.assert_close(roots[17], frames.motion.root_position[1:].mean(0))
    torch.testing.assert_close(roots[20], frames.ahead.root_position[0])
    assert torch.equal(roots[-1], frames.ahead.root_position[-1])
    assert max(float((b - a).norm()) for a, b in pairwise(roots)) < 0.15
    torch.testing.assert_close(frames.forecast.double(), frames.ahead.joint_positions(), atol=1e-5, rtol=0)
    with pytest.raises(RequestError, match="finite"):
        playback.at(math.nan)


def test_frames_that_were_rolled_back_are_not_shown():
    playback, (state, first) = Playback(), begun()
    playback.show(first, 0.0)
    _, wrong = played(state, Command(0.0, 3.0), 3)
    for k, frames in enumerate(wrong):
        playback.show(frames, (1 + 3 * k) / 30)
    state, (right,) = played(state, AHEAD, 1)
    playback.show(right, 1 / 30)
    assert torch.equal(playback.at(3 / 30).local_quat_xyzw, right.motion.local_quat_xyzw[2:])
    torch.testing.assert_close(playback.at(4 / 30).root_position[0], right.ahead.root_position[0])
    assert torch.equal(playback.at(0.0).root_position, first.motion.root_position)


@pytest.mark.parametrize("skeleton", [CANONICAL, LARGE], ids=["canonical", "large"])
def test_velocity_and_trajectory_are_those_of_the_motion(skeleton):
    state, first = steer.begin(DENSITY, AHEAD, generator=generator(), settings=QUICK, skeleton=skeleton)
    assert first.trajectory.shape == (0, 3)
    _, pieces = played(state, AHEAD, 3)
    roots = torch.cat([piece.motion.root_position for piece in (first, *pieces)])[:, ::2]
    moved = torch.cat([piece.root_velocity for piece in (first, *pieces)])
    torch.testing.assert_close(moved[1:].double(), 30 * roots.diff(dim=0), atol=1e-3, rtol=0)
    ahead = pieces[-1].trajectory
    torch.testing.assert_close(ahead[:, :2], pieces[-1].forecast[:, 0, ::2], atol=1e-5, rtol=0)
    hips = pieces[-1].ahead.joint_rotations()[:, 0]
    forward = 2 * torch.stack([hips[:, 0] * hips[:, 2] + hips[:, 3] * hips[:, 1], 0 * hips[:, 0]], dim=1)
    assert bool((forward[:, 0].sign() == ahead[:, 2].sin().sign()).all())


begin_anywhere = steer.begin.__wrapped__  # without the tests' own check of types, which users do not have


@pytest.mark.parametrize(
    "wrong",
    [
        lambda prior, state: steer.begin(prior, AHEAD, generator=generator(), at=(math.nan, 0.0)),
        lambda prior, state: begin_anywhere(prior, AHEAD, generator=generator(), at=(0.0, 0.0, 0.0)),
        lambda prior, state: begin_anywhere(prior, AHEAD, generator=generator(), at="ab"),
        lambda prior, state: steer.step.__wrapped__(state, AHEAD, seconds="soon"),
        lambda prior, state: steer.begin(prior, replace(AHEAD, labels=("swim",)), generator=generator()),
        lambda prior, state: steer.accept(prior, replace(AHEAD, labels=("swim",))),
        lambda prior, state: steer.step(state, replace(AHEAD, labels=("swim",))),
        lambda prior, state: ARRIVER(state, replace(GOING, labels=("swim",))),
        lambda prior, state: steer.step(state, AHEAD, seconds=math.nan),
    ],
)
def test_what_cannot_be_is_refused_where_it_is_given(wrong, tmp_path):
    prior = priors.load(str(save_tiny_prior(tmp_path / "p.safetensors", labels=("gait=run",))))
    state, _ = played(steer.begin(prior, AHEAD, generator=generator(), settings=QUICK)[0], GOING, 3)
    with pytest.raises(RequestError):
        wrong(prior, state)
