"""A density that is written from mapctl.protocols alone goes through every job that takes one."""

import pytest
import torch
from captures import noisy, on_rig
from helpers import generator
from tiny_denoiser import tiny_denoiser
from tiny_infiller import tiny_infiller
from toy_density import toy_density

from controllers.common.map_refinement import RefinementSettings
from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.inbetweening.proposers import AutoInbetweener, RolloutInbetweener
from controllers.inbetweening.tween import tween
from controllers.shots.shot import follow
from controllers.shots.walk import FollowSettings
from controllers.steering import steer
from mapctl import curves
from mapctl.intent.keyframes import Keys
from mapctl.intent.steering import Command
from mapctl.problem.receding_horizon import HorizonSettings
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings

TOY = toy_density()
WINDOW = HorizonSettings(frames=12, overlap=6)
REFINEMENT = RefinementSettings(lbfgs=LbfgsSettings(max_iterations=4), budget=Budget(evaluations=4))


def check(motion, frames):
    assert motion.num_frames == frames
    assert bool(torch.isfinite(motion.root_position).all())
    assert bool(torch.isfinite(motion.local_quat_xyzw).all())


def test_it_follows_a_curve():
    settings = FollowSettings(window=WINDOW, method=LatentNoiseSolver(budget=Budget(evaluations=24)))
    done = follow(TOY, curves.line(length=2), seconds=1, settings=settings, generator=generator())
    check(done.motion, 30)
    start, end = done.motion.root_position[[0, -1], 2].tolist()
    assert end - start == pytest.approx(29 * 1.2 / 30, abs=0.15)
    # Its legs know no steps.
    assert {note.split(" (")[0] for note in done.status.notes} <= {"feet", "soles", "support"}


def test_it_is_steered():
    settings = steer.SteerSettings(horizon=8, commit=3, evaluations=10, least_evaluations=2)
    command = Command(1.2, 0.5)
    state, _ = steer.begin(TOY, command, generator=generator(), settings=settings)
    for _ in range(3):
        state, piece = steer.step(state, command)
        check(piece.motion, 3)
    fast, said = steer.accept(TOY, Command(9.0, 0.0))
    assert fast.speed == TOY.limits.max_steering_speed
    assert len(said) == 1


@pytest.mark.slow
def test_it_is_a_prior_of_denoising():
    given = noisy(on_rig("bandai", 40))
    settings = DenoiseSettings(refinement=REFINEMENT)
    done, plain = (denoise(given, tiny_denoiser(), settings=settings, densities=some) for some in ([TOY], []))
    check(done.motion, 40)
    assert "likelihood" in [entry.name for entry in done.ledger.entries]
    assert not torch.equal(done.motion.local_quat_xyzw, plain.motion.local_quat_xyzw)


@pytest.mark.slow
def test_it_is_a_prior_of_tweening_and_proposes_rollouts():
    motion, keys = on_rig("bandai", 40), Keys((0, 20, 39))
    infiller = tiny_infiller(drawn=0.02)
    quick = LatentNoiseSolver(rounds=1, lbfgs=LbfgsSettings(max_iterations=6), budget=Budget(evaluations=20))
    for inbetweener in (AutoInbetweener(infiller, [TOY]), RolloutInbetweener([TOY], infiller, ahead=4, solver=quick)):
        done = tween(motion, keys, inbetweener, refinement=REFINEMENT, densities=[TOY])
        check(done.motion, 40)
        torch.testing.assert_close(done.motion.local_quat_xyzw[[0, 20, 39]], motion.local_quat_xyzw[[0, 20, 39]])
    assert {source.by for source in done.sources} == {"rollout of toy"}
