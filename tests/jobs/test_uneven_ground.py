"""Walks on ground that is not flat: feet stand on treads and slopes, swings clear edges, hips follow smoothly."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers import generator, run

import controllers
import priors
from controllers.denoising.trajectory import correct_trajectory
from controllers.shots.request import Arrival, Lead, PoseKey, Reach, ShotRequest
from controllers.shots.shot import solve_shot
from controllers.shots.stairs import Stairs
from controllers.shots.trajectory import plan_trajectory
from controllers.shots.uneven import step_onto_ground
from mapctl import curves, rotations
from mapctl.errors import RequestError
from mapctl.ground import Ground
from mapctl.intent.path import SpeedProfile
from mapctl.metrics.feet import locate_heels
from mapctl.retarget.legs import lower_by
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES
from mapctl.terms import RootVelocity, StepLength
from scenes import overlays
from scenes.stage import Shot, Stage

RISE, TREAD, STEPS, KERB, FIRST = 0.17, 0.29, 4, 0.15, 2.6
GROUND = f"""
[[ramps]]
start = [0, 0.6]
end = [0, 1.8]
heights = [0.0, 0.2]

[[boxes]]
centre = [0, 2.2]
size = [2, 0.8]
height = {0.2 + KERB}

[[stairs]]
start = [0, {FIRST}]
steps = {STEPS}
rise = {RISE}
tread = {TREAD}
base = {0.2 + KERB}

[[boxes]]
centre = [0, {FIRST + STEPS * TREAD + 2.0}]
size = [2, 4]
height = {0.2 + KERB + STEPS * RISE}
"""


def height_at(z):
    """The ground along the path, by hand."""
    if z < 0.6:
        return 0.0
    if z < 1.8:
        return (z - 0.6) / 6
    return 0.2 + KERB + RISE * min(STEPS, max(0, math.floor((z - FIRST) / TREAD) + 1))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    found = tmp_path_factory.mktemp("ground") / "ground.toml"
    found.write_text(GROUND)
    return found


@pytest.fixture(scope="module")
def walked(path):
    return controllers.follow(
        priors.load("locomotion"), curves.line(length=5), ground=Ground.read(path), generator=generator(0)
    )


def test_planted_feet_stand_on_one_plane_of_the_ground(walked):
    toes, heels = walked.motion.joint_positions()[:, list(CANONICAL.indices(TOES))], locate_heels(walked.motion)
    standing = [
        (one, other) for foot in range(2) for one, other in pairwise([s for s in walked.footsteps if s.foot == foot])
    ]
    assert len(standing) > 6
    for one, other in standing:
        middle = (one.land + other.lift) // 2
        toe, heel = toes[middle, one.foot], heels[middle, one.foot]
        ends = [float(heel[2]), float(toe[2]) + 0.07]
        sloped = min(ends) > 0.6 and max(ends) < 1.8
        assert float(toe[1]) - height_at(float(toe[2])) == pytest.approx(TOE_REST_HEIGHT, abs=0.02)
        if not sloped:
            assert height_at(ends[0]) == pytest.approx(height_at(ends[1]), abs=0.02), ends


def test_each_step_of_the_stairs_is_one_tread(walked):
    levels = [round((height_at(step.toe[1]) - 0.2 - KERB) / RISE, 3) for step in walked.footsteps if step.toe[1] > 2]
    assert levels[-1] == STEPS
    climbed = [level for level in levels if level > 0]
    assert climbed[:STEPS] == list(range(1, STEPS + 1))


def test_swing_feet_clear_edges_and_no_foot_is_in_the_ground(walked):
    footing = walked.footing
    assert footing.clearance > 0.02
    assert footing.penetration < 0.01
    assert footing.over_edge == 0
    toes, heels = walked.motion.joint_positions()[:, list(CANONICAL.indices(TOES))], locate_heels(walked.motion)
    for each, below in ((toes, TOE_REST_HEIGHT), (heels, TOE_REST_HEIGHT - 0.0201)):
        over = [float(y) - below - height_at(float(z)) for _, y, z in each.reshape(-1, 3)]
        assert min(over) > -0.02


def test_hips_rise_with_the_ground_without_a_jolt(walked):
    hips = walked.motion.root_position
    assert float(hips[-1, 1] - hips[0, 1]) == pytest.approx(height_at(5.0), abs=0.05)
    assert float(hips.diff(n=2, dim=0)[:, 1].abs().max()) * 900 < 7  # m/s^2; 4 on a flat floor


def test_a_flat_ground_changes_neither_feet_nor_hips(walk_motion):
    stepped = step_onto_ground(walk_motion, Ground(), TOE_REST_HEIGHT)
    done, footing = stepped.motion, stepped.measure_footing()
    kept = [0, *CANONICAL.indices(TOES)]
    apart = (done.joint_positions() - walk_motion.joint_positions())[:, kept].norm(dim=-1)
    assert float(apart.max()) < 0.002
    assert footing.clearance == math.inf


@pytest.fixture(scope="module")
def walk_motion():
    return controllers.follow(priors.load("locomotion"), curves.line(length=2), generator=generator(0)).motion


def test_what_the_density_does_not_know_is_named(walk_motion, tmp_path):
    steep = tmp_path / "steep.toml"
    steep.write_text("[[ramps]]\nstart = [0, -1]\nend = [0, 3]\nheights = [0, 1.6]\nwidth = 9.0")
    footing = step_onto_ground(walk_motion, Ground.read(steep), TOE_REST_HEIGHT).measure_footing()
    assert math.degrees(footing.steepest) == pytest.approx(math.degrees(math.atan(0.4)), abs=0.1)
    assert len(footing.notes) == 1
    assert "22 degrees" in footing.notes[0]


def test_speeds_are_lower_on_stairs_alone(path):
    line = curves.line(length=6)
    slow = Stairs.find(line, Ground.read(path)).slow(SpeedProfile.constant(1.2), line, 0.54)
    assert slow.at(FIRST + TREAD) == pytest.approx(TREAD / 0.5, abs=0.02)
    assert slow.at(0.5) == slow.at(5.9) == 1.2


def test_terms_of_stairs_hold_on_them_alone(path):
    trajectory = plan_trajectory(ShotRequest(curves.line(length=6), SpeedProfile.constant(0.6)))
    stairs = Stairs.find(trajectory.curve, Ground.read(path))
    facing, steps = stairs.terms(trajectory, 30 * 5, 34)  # 3 m along
    assert isinstance(facing, RootVelocity)
    assert isinstance(steps, StepLength)
    assert steps.length == pytest.approx(TREAD, abs=0.01)
    assert facing.facing is not None
    assert float(facing.facing.abs().max()) < 0.01
    assert stairs.terms(trajectory, 0, 34) == Stairs.find(trajectory.curve, None).terms(trajectory, 150, 34) == ()


def test_hands_reach_over_the_ground(path):
    target, ground = (0.35, 1.5, 2.9), Ground.read(path)
    request = ShotRequest(curves.line(length=3), reaches=(Reach(3.0, {"leftHand": target}),), ground=ground)
    transformer = priors.load_inbetweener("transformer")
    done = solve_shot(priors.load("locomotion"), transformer, request, generator=generator(0))
    hand = done.motion.joint_positions()[90, CANONICAL.index("leftHand")]
    assert float((hand - hand.new_tensor(target)).norm()) < 0.01
    assert next(one for one in done.constraints if one.name.startswith("leftHand")).holds
    assert done.footing is not None
    assert done.footing.penetration < 0.01


def test_poses_and_footsteps_are_met_on_the_ground(walked, path):
    """A body that bows on the kerb, and a foothold that is moved there."""
    step = next(step for step in walked.footsteps if 1.9 < step.toe[1] < 2.4)
    step = replace(step, toe=(step.toe[0] + 0.08, step.toe[1]))
    ground, at = Ground.read(path), (step.land + 30) / 30
    key = PoseKey(at, height=0.80, tolerance=0.01)
    request = ShotRequest(curves.line(length=5), poses=(key,), footsteps=(step,), ground=ground)
    transformer = priors.load_inbetweener("transformer")
    done = solve_shot(priors.load("locomotion"), transformer, request, generator=generator(0))
    toe = done.motion.joint_positions()[step.land, CANONICAL.index(TOES[step.foot])].double()
    assert float((toe[::2] - toe.new_tensor(step.toe)).norm()) < 0.05
    assert float(toe[1]) - float(ground.height(toe[::2])) == pytest.approx(TOE_REST_HEIGHT, abs=0.02)
    hips = done.motion.root_position[round(at * 30)].double()
    assert float(hips[1] - ground.height(hips[::2])) == pytest.approx(0.80, abs=0.15)
    assert all(one.holds for one in done.constraints if "at" in one.name), done.constraints
    assert done.footing is not None
    assert done.footing.penetration < 0.01


def test_a_foothold_of_a_fixed_frame_stays(walk_motion, path):
    ground = Ground.read(path)
    moved = max(step_onto_ground(walk_motion, ground, TOE_REST_HEIGHT).holds, key=lambda hold: float(hold.moved.norm()))
    assert float(moved.moved.norm()) > 0.02
    fixed = step_onto_ground(walk_motion, ground, TOE_REST_HEIGHT, keys=[moved.start]).holds
    same = next(hold for hold in fixed if (hold.foot, hold.start) == (moved.foot, moved.start))
    assert float(same.moved.norm()) < 1e-9


def find_level_frame(motion, ground, first):
    """The first frame from one on with both toes over ground of one height."""
    heights = ground.height(motion.joint_positions()[first:, list(CANONICAL.indices(TOES)), ::2].double())
    return first + int((heights.diff(dim=1).abs()[:, 0] < 0.001).nonzero()[0])


@pytest.mark.parametrize("floor", [False, True])
def test_a_shot_continues_from_a_clip_and_ends_in_one_on_the_ground(walked, path, floor):
    """On the ground, or over a floor of its own."""
    ground, motion = Ground.read(path), walked.motion
    at = find_level_frame(motion, ground, round(2.1 / 5 * motion.num_frames))
    to = find_level_frame(motion, ground, motion.num_frames - 25)
    lead, arrival = Lead.of(motion, at), Arrival.of(motion, to)
    line = curves.line(length=float(motion.root_position[to, 2] - motion.root_position[at, 2]))
    curve = lead.bring_curve(line)
    if floor:
        lead = Lead(lower_by(lead.motion, ground.height(lead.motion.root_position[-1:, ::2].double())))
    request = ShotRequest(curve, lead=lead, arrival=arrival, ground=ground)
    transformer = priors.load_inbetweener("transformer")
    done = solve_shot(priors.load("locomotion"), transformer, request, generator=generator(0))
    for frame, met in ((0, motion.slice(at, at + 1)), (-1, motion.slice(to, to + 1))):
        off = done.motion.joint_positions()[frame] - met.joint_positions()[0]
        assert float(off[:, 1].abs().max()) < 0.003
        assert frame or float(off.norm(dim=-1).max()) < 0.003  # where it ends, the clip is moved to the path
    assert done.footing is not None
    assert done.footing.penetration < 0.01


def test_loops_and_clips_over_edges_are_refused_on_a_ground(walked, path):
    ground = Ground.read(path)
    with pytest.raises(RequestError, match="does not loop"):
        ShotRequest(curves.circle(radius=3), loop=True, ground=ground)
    heights = ground.height(walked.motion.joint_positions()[:, list(CANONICAL.indices(TOES)), ::2].double())
    lead = Lead.of(walked.motion, int(heights.diff(dim=1).abs()[:, 0].argmax()))
    curve = lead.bring_curve(curves.line(length=1))
    with pytest.raises(RequestError, match="level ground"):
        ShotRequest(curve, lead=lead, ground=ground).lower_clips(ground, TOE_REST_HEIGHT, curve, 1.0)


def test_stairs_may_begin_with_the_walk(tmp_path):
    """Its first window has a start for each candidate."""
    stairs = tmp_path / "stairs.toml"
    stairs.write_text("[[stairs]]\nstart = [0, 0.7]\nsteps = 3\nrise = 0.15\ntread = 0.3\n")
    done = controllers.follow(
        priors.load("locomotion"), curves.line(length=1.4), ground=Ground.read(stairs), generator=generator(0)
    )
    assert done.footing is not None
    assert done.footing.penetration < 0.01


def measure_depth(motion, ground):
    """The deepest that a toe joint is, beyond its height at rest."""
    toes = motion.joint_positions()[:, list(CANONICAL.indices(TOES))].double()
    return float((ground.height(toes[..., ::2]) + TOE_REST_HEIGHT - toes[..., 1]).max())


def test_keys_that_stand_on_stairs_are_met_and_the_motion_between_them_is_over_the_ground(walked, path):
    ground, frames = Ground.read(path), [*range(0, walked.motion.num_frames - 20, 40), walked.motion.num_frames - 1]
    model, keys = priors.load_inbetweener("transformer"), controllers.Keys.of(frames)
    flat, done = (controllers.tween(walked.motion, keys, model, ground=under) for under in (None, ground))
    assert torch.equal(done.motion.root_position[frames], walked.motion.root_position[frames])
    turned = rotations.turns_between(done.motion.local_quat_xyzw, walked.motion.local_quat_xyzw)
    assert float(turned[frames].abs().max()) < 1e-6
    away = [one.motion.joint_positions() - walked.motion.joint_positions() for one in (flat, done)]
    assert float(away[1].norm(dim=-1).mean()) < 0.8 * float(away[0].norm(dim=-1).mean())
    assert measure_depth(done.motion, ground) < 0.06 < 0.15 < measure_depth(flat.motion, ground)
    assert done.footing is not None
    assert done.footing.penetration < 0.02


def test_only_whole_poses_stand_on_a_ground(walk_motion, path):
    keys = controllers.Keys.of([0, 20, 40], root_only=True)
    with pytest.raises(RequestError, match="whole poses"):
        controllers.tween(walk_motion, keys, priors.load_inbetweener("transformer"), ground=Ground.read(path))


def test_hips_that_drift_are_brought_back_onto_the_ground(walked, path):
    truth = walked.motion.root_position
    seconds = torch.arange(len(truth), dtype=torch.float64)[:, None] / 30
    drift = 0.05 * torch.sin(seconds * torch.tensor([6.3, 8.1, 7.2]) + torch.tensor([0.0, 1.0, 2.0]))
    capture = replace(walked.motion, root_position=truth + drift)
    found = correct_trajectory(capture, ground=Ground.read(path))
    assert found.from_video
    assert float((found.motion.root_position - truth)[:, 1].std()) < 0.5 * float(drift[:, 1].std())
    assert float((found.motion.root_position - truth)[:, ::2].abs().mean()) < float(drift[:, ::2].abs().mean())
    on_floor = correct_trajectory(capture).motion.root_position
    assert float((on_floor - truth)[:, 1].abs().max()) > 0.3


def test_commands_refuse_what_a_ground_does_not_go_with(path, tmp_path, capsys):
    script, out = tmp_path / "commands.csv", tmp_path / "out.bvh"
    script.write_text("time_s,speed_mps,heading_deg\n0,0.8,0\n2,0.8,0\n")
    assert run("steer", script, "-o", out, "--ground", path, "--report", out.with_suffix(".json")) == 0
    assert "ground    swing" in capsys.readouterr().out
    assert json.loads(out.with_suffix(".json").read_text())["footing"]["penetration_max_cm"] < 2
    assert run("steer", script, "-o", out, "--ground", path, "--stream", "127.0.0.1:39539", "--realtime") == 2
    assert "leave one out" in capsys.readouterr().err
    assert run("denoise", "example:noisy-walk", "-o", out, "--ground", path, "--capture", "studio") == 2
    assert "captures from video" in capsys.readouterr().err


def test_the_command_reports_how_feet_stand(path, tmp_path, capsys):
    out, report = tmp_path / "walk.bvh", tmp_path / "walk.json"
    assert run("follow", "line:2", "-o", out, "--report", report, "--ground", path) == 0
    assert "ground    swing" in capsys.readouterr().out
    found = json.loads(report.read_text())
    assert found["footing"]["penetration_max_cm"] < 1
    assert found["footing"]["slope_max_deg"] == pytest.approx(math.degrees(math.atan(1 / 6)), abs=0.5)
    path.with_name("bad.toml").write_text("[[boxes]]\ncentre = [0, 0]")
    assert run("follow", "line:2", "-o", out, "--ground", path.with_name("bad.toml")) == 2


def test_films_draw_the_ground_and_lay_trails_on_it(walk_motion, path):
    ground = Ground.read(path)
    tops = overlays.build_ground(ground).vertices[:, 1].max()
    assert tops == pytest.approx(0.2 + KERB + STEPS * RISE)
    trail = Stage([Shot(walk_motion)], ground=ground).compose_ghosts([0]).ground[1].vertices
    raised = trail[:, 1] - [height_at(z) for z in trail[:, 2]]
    assert trail[:, 1].max() > 0.1
    assert raised == pytest.approx(overlays.TRAIL_HEIGHT, abs=1e-6)
