"""Toes land without a snap where motion is made: in walks along curves and in the clean-up of generated motion."""

import pytest
import torch
from helpers import generator

import controllers
import priors
from mapctl import curves
from mapctl.metrics.body import measure_peaks
from mapctl.skeleton import CANONICAL, TOES


@pytest.mark.slow
def test_no_toe_snaps_along_the_demos_curve():
    """Without the limit a toe is 14 cm further within one frame of this walk, and then stands: 132 m/s^2."""
    curve = curves.figure8(radius=2.0)
    walk = controllers.follow(priors.load("locomotion"), curve, seconds=18.5, generator=generator(0)).motion
    positions = walk.joint_positions()
    peaks = measure_peaks(positions[:, list(CANONICAL.indices(TOES))], positions[:, 0], float(walk.fps))
    assert peaks.acceleration < 90
    assert torch.isfinite(positions).all()
