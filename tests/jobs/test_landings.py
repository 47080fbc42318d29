"""Toes land without a snap where motion is made: in walks along curves and in the clean-up of generated motion."""

from dataclasses import replace

import pytest
import torch
from helpers import generator

import controllers
import priors
from controllers.common.character import Character
from controllers.shots.walk import FollowSettings
from mapctl import curves
from mapctl.metrics.body import measure_peaks
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES


def test_a_body_of_twice_the_size_may_accelerate_twice_as_hard():
    """Terms see it at the size of the priors' body."""
    giant = replace(CANONICAL, offsets=2 * CANONICAL.offsets)
    landing = Character(giant, 2 * TOE_REST_HEIGHT).footing(FollowSettings().footing).landing
    assert landing is not None
    assert (2 * landing.free, 2 * landing.sigma) == pytest.approx((70.0, 10.0))


@pytest.mark.slow
def test_no_toe_snaps_along_the_demos_curve():
    """Without the limit a toe is 14 cm further within one frame of this walk, and then stands: 132 m/s^2."""
    curve = curves.figure8(radius=2.0)
    walk = controllers.follow(priors.load("locomotion"), curve, seconds=18.5, generator=generator(0)).motion
    positions = walk.joint_positions()
    peaks = measure_peaks(positions[:, list(CANONICAL.indices(TOES))], positions[:, 0], float(walk.fps))
    assert peaks.acceleration < 90
    assert torch.isfinite(positions).all()
