"""The MAP stage: near the proposal, on feet that stand."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import generator, tiny_density, walk

from controllers.common.map_refinement import RefinementSettings, refine
from mapctl import rotations
from mapctl.contacts import debounced
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.problem import window_solvers
from mapctl.problem.density_selection import DensityEnsemble
from mapctl.problem.receding_horizon import HorizonSettings
from mapctl.problem.unknowns import WindowContext
from mapctl.problem.window_solvers import PoseOffsets
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance

TOE = CANONICAL.indices(TOES)
QUICK = RefinementSettings(lbfgs=LbfgsSettings(max_iterations=20), budget=Budget(evaluations=20))


def windows(frames, overlap):
    return HorizonSettings(frames, overlap, beyond_end=False)


def standing_still(frames=60, *, drift=0.0):
    """One pose, sliding sideways by so many metres a second."""
    pose = walk(1)
    seconds = torch.arange(frames, dtype=torch.float64) / PRIOR_FPS
    root = pose.root_position + torch.stack([drift * seconds, 0 * seconds, 0 * seconds], dim=-1)
    return Motion(CANONICAL, pose.fps, root, pose.local_quat_xyzw.expand(frames, -1, -1).clone())


def capture_of(motion, *, degrees=3.0, centimetres=2.0):
    """A capture of it, everything seen."""
    seen = torch.ones(motion.num_frames, CANONICAL.num_joints, dtype=torch.bool)
    sigma = torch.full((CANONICAL.num_joints,), math.radians(degrees))
    return Capture.of_motion(motion, seen=seen, seen_root=seen[:, 0], sigma=sigma, sigma_root=centimetres / 100)


def odds(motion, left=5.0, right=5.0):
    return torch.tensor([left, right]).expand(motion.num_frames, 2).contiguous()


def speeds(motion):
    """Speeds of the toes over the ground, m/s (frames - 1, 2)."""
    toes = motion.joint_positions()[:, TOE][..., ::2]
    return torch.diff(toes, dim=0).norm(dim=-1) * PRIOR_FPS


def offsets_of(motion, contacts, dtype=torch.float32, sigma=0.05):
    pose = BodyPose.unpack(BodyPose.of_motion(motion).pack().to(dtype))
    start = GroundPose(pose.root_position[0, ::2], pose.heading[0])
    before = torch.zeros(0, CANONICAL.num_joints, 3, dtype=dtype)
    context = WindowContext(DensityEnsemble([]), (), start, before, motion.num_frames)
    return PoseOffsets(context, pose, contacts, torch.full(pose.pack().shape, sigma, dtype=dtype))


def test_unknowns_of_unit_variance_move_poses_by_their_sigma_and_smoothly():
    poses = offsets_of(walk(60), torch.zeros(60, 2, dtype=torch.bool), torch.float64)
    white = torch.randn(150, poses.sigma.numel(), generator=generator(), dtype=torch.float64)
    heights = poses.build(white).joints_world[:, :, 0, 1] - poses.proposal.root_position[:, 1]
    assert float(heights.square().mean().sqrt()) == pytest.approx(0.05, rel=0.1)
    step = torch.diff(heights, dim=1).square().mean().sqrt()
    assert step < 0.6 * heights.square().mean().sqrt()  # white ones would differ by 1.4 times


def test_planted_toes_that_slide_slow_down_and_joints_stay_near():
    motion = standing_still(60, drift=0.2)
    stood = refine(motion, odds(motion), capture_of(motion), QUICK)
    before, after = speeds(motion), speeds(stood.motion)
    assert after[2:].mean() < 0.6 * before[2:].mean()
    assert (stood.motion.joint_positions() - motion.joint_positions()).norm(dim=-1).mean() < 0.15
    assert stood.contacts.all()


def test_a_capture_without_noise_stays_but_for_half_millimetres():
    motion = walk(60)
    stood = refine(motion, odds(motion), capture_of(motion, degrees=0.0, centimetres=0.0), QUICK)
    assert (stood.motion.joint_positions() - motion.joint_positions()).norm(dim=-1).max() < 0.005


def test_what_was_not_seen_moves_before_what_was():
    motion = standing_still(40, drift=0.2)
    capture = capture_of(motion, degrees=0.5, centimetres=0.1)
    lost = replace(capture, seen_root=torch.zeros(1, 40, dtype=torch.bool))
    held, free = (speeds(refine(motion, odds(motion), given, QUICK).motion)[2:].mean() for given in (capture, lost))
    assert free < 0.5 * held


def test_a_density_counts_less_in_windows_that_are_out_of_its_depth():
    """The windows say so, and the energy is divided by what is lost."""
    motion, settings = walk(50), replace(QUICK, window=windows(30, 10), budget=Budget(evaluations=2))
    deep = tiny_density()
    shallow = replace(deep, card=replace(deep.card, quality={"windows": {"p2": 1e5}}))
    found = {}
    for density in (deep, shallow):
        stood = refine(motion, odds(motion), capture_of(motion), settings, densities=[density])
        intervals = stood.density_intervals(stood.motion)
        assert [(part.start, part.stop) for part in intervals] == [(0, 20), (20, 50)]
        (entry,) = (entry for entry in stood.ledger.entries if entry.name == "likelihood")
        scale = torch.cat([torch.full((part.stop - part.start,), part.weight) for part in intervals])
        assert torch.allclose(entry.energy * settings.temperature, entry.residual * scale, rtol=1e-4)
        found[density] = {part.weight for part in intervals}
    assert found[deep] == {1.0}
    assert max(found[shallow]) < 1e-3


@pytest.mark.slow
def test_every_frame_comes_back_once_whatever_the_windows(monkeypatch):
    motion = walk(70, turn_rate=0.6)
    for frames, ahead in ((96, 24), (70, 8), (20, 8), (33, 1)):
        settings = replace(QUICK, window=windows(frames, ahead), budget=Budget(evaluations=2))
        stood = refine(motion, odds(motion, -5.0, -5.0), capture_of(motion), settings)
        assert stood.motion.num_frames == len(stood.contacts) == 70
        assert (stood.motion.joint_positions() - motion.joint_positions()).norm(dim=-1).max() < 0.03
        assert all(len(entry.energy) == 70 for entry in stood.ledger.entries)


def test_windows_meet_without_a_jump():
    """A slide that many windows work on: the hips' accelerations where two meet are as elsewhere."""
    motion = standing_still(120, drift=0.2)
    settings = replace(QUICK, window=windows(40, 16))
    out = refine(motion, odds(motion), capture_of(motion), settings).motion
    jump = torch.diff(out.joint_positions(), n=2, dim=0).norm(dim=-1).amax(dim=-1)
    seams = torch.zeros(len(jump), dtype=torch.bool)
    for seam in (24, 48, 72):
        seams[seam - 3 : seam + 2] = True
    assert jump[seams].max() < 0.02
    assert torch.diff(out.joint_positions(), dim=0).norm(dim=-1).max() < 0.03


@pytest.mark.slow
def test_a_window_without_a_finite_solution_is_left_as_proposed(monkeypatch):
    motion = standing_still(50, drift=0.2)
    found = window_solvers.minimise

    def lost(*args, **kwargs):
        result = found(*args, **kwargs)
        return replace(result, x=torch.full_like(result.x, math.nan), energy=torch.full_like(result.energy, math.nan))

    monkeypatch.setattr(window_solvers, "minimise", lost)
    stood = refine(motion, odds(motion), capture_of(motion), replace(QUICK, window=windows(30, 10)))
    assert stood.motion.num_frames == 50
    assert (stood.motion.joint_positions() - motion.joint_positions()).norm(dim=-1).max() < 1e-4


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_proposals_break_nothing(frames):
    motion = walk(frames)
    stood = refine(motion, odds(motion), capture_of(motion), QUICK)
    assert stood.motion.num_frames == frames
    assert (stood.motion.joint_positions() - motion.joint_positions()).norm(dim=-1).max() < 0.1


def test_no_contact_and_no_gap_in_one_is_short():
    bits = torch.rand(200, 40, generator=generator()) < torch.linspace(0.1, 0.9, 40)
    for pair in bits.split(2, dim=1):
        found = debounced(pair)
        for mask in (found, ~found):
            assert all(stop - start >= 3 for _, start, stop in true_intervals(mask))
        assert torch.equal(debounced(found), found)


def test_a_body_that_lies_stays_however_sure_the_contacts():
    motion = walk(60)
    down = rotations.from_rotation_vector(torch.tensor([-math.pi / 2, 0.0, 0.0]).double())
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(down, quats[:, 0])
    lying = replace(motion, root_position=rotations.rotate(down, motion.root_position), local_quat_xyzw=quats)
    stood = refine(lying, odds(motion), capture_of(motion), QUICK)
    assert not stood.contacts.any()
    assert (stood.motion.joint_positions() - lying.joint_positions()).norm(dim=-1).max() < 0.002


def test_feet_stay_on_the_box_that_they_rest_on():
    """Up in the middle of the take, by 48 cm in half a second: toes are not pulled towards the floor, nor is that."""
    motion = standing_still(90, drift=0.05)
    rise = 0.48 * ((torch.arange(90) - 40) / 15).clamp(0, 1).double()
    motion = replace(motion, root_position=motion.root_position + rise[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    stood = refine(motion, odds(motion), capture_of(motion), QUICK)
    assert stood.contacts[:38].all()
    assert stood.contacts[58:].all()
    assert not stood.contacts[43:54].any()
    heights = motion.joint_positions()[:, TOE, 1]
    apart = (stood.motion.joint_positions()[:, TOE, 1] - heights).abs()
    assert apart[torch.cat([torch.arange(38), torch.arange(58, 90)])].max() < 0.015
    assert torch.allclose(stood.supports[-1] - stood.supports[0], torch.tensor(0.48).double(), atol=0.001)


def test_toes_that_slide_unseen_are_lifted_and_those_that_were_seen_are_not():
    motion = standing_still(drift=1.5)
    capture = capture_of(motion, degrees=0.0, centimetres=0.0)
    seen = torch.ones(60, dtype=torch.bool)
    seen[15:45] = False
    capture = replace(capture, seen=seen[None, :, None].expand_as(capture.seen), seen_root=seen[None])
    heights = [
        refine(
            motion, odds(motion, -5.0, -5.0), capture, replace(QUICK, clearance=clearance, uncertainty_ramp=5.0)
        ).motion.joint_positions()[:, TOE, 1]
        for clearance in (None, Clearance())
    ]
    lifts = heights[1] - heights[0]
    assert float(lifts[25:35].min()) > 0.01
    assert float(lifts[seen].abs().max()) < 2e-3
