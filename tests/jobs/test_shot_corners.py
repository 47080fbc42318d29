"""Corners and reversals of a shot by the bundled models: how far they are left, and how hard a toe is accelerated."""

import math

import numpy as np
import pytest
import torch

import priors
from controllers.shots.request import ShotRequest
from controllers.shots.shot import solve_shot
from mapctl import curves, kinematics, rotations
from mapctl.skeleton import CANONICAL, TOES


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("last", [(2.2, 2.2), (0.0, 0.6)], ids=["right angle", "reversal"])
def test_a_corner_is_kept_to_without_a_lunge(last, seed):
    prior = priors.load("locomotion")
    curve = curves.from_points(np.array([(0.0, 0.0), (0.0, 2.2), last]), closed=False)
    drawn = torch.Generator().manual_seed(seed)
    done = solve_shot(prior, priors.load_inbetweener(), ShotRequest(curve), generator=drawn)
    assert done.status.ok, done.status.text
    hips = done.motion.root_position[:, ::2]
    off = (hips - done.trajectory.curve.point(done.trajectory.curve.nearest(hips, done.trajectory.arcs))).norm(dim=-1)
    assert float(off.max()) < (0.1 if last[0] else 0.15), "what the page of limits says"
    toes = done.motion.joint_positions()[:, list(CANONICAL.indices(TOES))]
    assert float(torch.diff(toes, n=2, dim=0).norm(dim=-1).max()) * 900 < 88, "twice that of a circle of 2 m"
    wanted = math.pi / 2 if last[0] else math.pi
    turned = rotations.wrap_angle(kinematics.heading(done.motion.local_quat_xyzw[-30:, 0]) - wanted)
    # Over a stride: at each step hips turn to and fro, by up to 17 degrees in mocap.
    assert abs(float(turned.mean())) < math.radians(15)
    if not last[0]:
        assert float((done.trajectory.speeds == 0).sum()) > 10, "it turns on the spot"


@pytest.mark.parametrize(("curve", "heels"), [("circle:1", True), ("line:3", True), ("wave:0.5x2", False)])
def test_heels_are_left_free_where_the_way_has_a_corner(curve, heels, monkeypatch):
    class Walked(Exception):
        """Walking has begun."""

    def walk(*_given, settings, **_more):
        raise Walked(settings.footing.heels is not None)

    monkeypatch.setattr("controllers.shots.shot.walk_spans", walk)
    with pytest.raises(Walked, match=str(heels)):
        solve_shot(priors.load("locomotion"), priors.load_inbetweener(), ShotRequest(curves.read(curve)))
