"""What actors are asked for, in films: marks are strong at their time, poses are bodies that one sees through."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers import moved
from helpers import walk as walk_ahead
from scenes_walks import walk

import priors
from controllers.common.character import Character
from controllers.shots.keys.posing import MetPose
from controllers.shots.planning.way import plan_way
from controllers.shots.request import Look, PoseKey, Reach, ShotRequest
from controllers.shots.shot import ShotSolution
from mapctl import curves
from mapctl.commands.shared.shots.plan import ShotPlan
from mapctl.commands.shared.shots.play import PlayedShot
from mapctl.commands.shared.shots.stage import build_obstacles, stage_actor
from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Status
from scenes.cameras import CameraSettings
from scenes.content import Content
from scenes.props import build_hips_mark, build_look_mark, build_target
from scenes.renderers import offscreen
from scenes.renderers.select import select_painter
from scenes.scene_file import Actor
from scenes.stage import Shot, Stage
from scenes.wishes import Mark, Wishes


def test_a_mark_is_strong_at_its_time_and_faint_at_others():
    target = build_target((0.4, 1.2, 1.0))
    momentary, held = Mark(target, (1.0, 1.0)), Mark(target, (1.5, 2.5))
    stage = Stage([Shot(walk(48, fps=12), start_seconds=1.0, wishes=Wishes([momentary, held]))])

    def opacities(seconds: float) -> list[float]:
        return [float(surface.rgba[0, 3]) for surface in stage.content(round(12 * seconds)).ground[-2:]]

    seen = [opacities(seconds) for seconds in (1.0, 2.0, 2.25, 2.5, 3.5, 3.75)]
    assert [[value == 1 for value in both] for both in seen] == [
        [False, False],
        [True, False],
        [False, False],
        [False, True],
        [False, True],
        [False, False],
    ]
    assert all(0.1 < value < 0.5 or value == 1 for both in seen for value in both)
    assert all(surface.rgba[0, 3] == 1 for surface in stage.compose_ghosts([0, 20]).ground[-2:]), "a sheet shows all"


@pytest.mark.parametrize("renderer", ["egl", "stick"])
def test_one_sees_through_a_pose_and_it_covers_the_actor_who_is_in_it(renderer):
    try:
        brush = select_painter(renderer)
    except offscreen.NoGraphicsError:
        pytest.skip("no OpenGL without a window here")
    motion = walk(6, speed=0.0)
    beside = moved(motion.slice(2, 3), turn=0.0, shift=(0.7, 0.0))
    stage = Stage([Shot(motion, wishes=Wishes(poses=[beside, motion.slice(2, 3)]))])
    content = stage.content(2)
    assert len(content.veils) == 2
    view = stage.views(CameraSettings(azimuth_deg=0.0, elevation_deg=5.0, zoom=0.5), (160, 160))[0]
    plain = brush.paint(view, Content(content.ground, content.figures)).astype(float)
    seen = brush.paint(view, content).astype(float)
    changed = np.abs(seen - plain).max(axis=2) > 8
    red = colours.rgb(colours.TARGET) @ [1, -0.5, -0.5]
    assert (seen - plain)[changed].mean(axis=0) @ [1, -0.5, -0.5] / 255 > 0.1 * red
    for place in (view.project(np.array([[0.7, 1.2, 0.0]])), view.project(np.array([[0.0, 1.2, 0.0]]))):
        column, row = np.rint(place[0, :2]).astype(int)
        around = changed[row - 4 : row + 5, column - 4 : column + 5]
        assert around.mean() > 0.7
        assert np.abs(seen[row, column] - 255 * colours.rgb(colours.TARGET)).max() > 30, "not opaque"
    assert changed.mean() < 0.3


def test_a_pose_is_as_high_as_the_actors_body_in_it():
    motion = walk(24)
    asked = Wishes(poses=[replace(motion.slice(7, 8), fps=Fraction(30))])
    (figure,) = Stage([Shot(motion, wishes=asked)]).content(0).veils
    own = Stage([Shot(motion)]).content(7).figures[0].surface()
    apart = np.linalg.norm(figure.surface().vertices - own.vertices, axis=1)
    assert apart.max() < 0.03
    assert apart.min() > 0.005, "around it"


def test_a_place_has_an_arrow_where_it_tells_a_facing():
    place = np.array([1.0, 2.0])
    disc, arrow = build_hips_mark(place, None), build_hips_mark(place, math.pi / 2)
    assert np.abs(disc.vertices[:, [0, 2]] - place).max() < 0.2
    tip = arrow.vertices[arrow.vertices[:, 0].argmax()]
    assert tip[[0, 2]] == pytest.approx([1.48, 2.0], abs=0.01)
    assert len(arrow.faces) > len(disc.faces)
    assert build_look_mark((1.0, 2.0, 3.0)).vertices.mean(axis=0) == pytest.approx([1.0, 2.0, 3.0])


def test_a_shot_on_stage_shows_all_that_it_was_asked_for():
    motion, crouched = walk_ahead(90), walk_ahead(1)
    keys = (PoseKey(1.0, crouched), PoseKey(2.0, facing_deg=40.0), PoseKey(2.5, crouched, root_only=True))
    frames = zip(keys, (32, 60, 75), strict=True)
    met = tuple(MetPose(key, motion.slice(at, at + 1), at, at + 4) for key, at in frames)
    wall = Obstacle((3.0, 3.0), 0.3)
    request = ShotRequest(curves.line(length=3), looks=(Look(0.5, (2.0, 1.0, 2.0), 0.2),), obstacles=(wall,))
    reaches = (Reach(1.5, {"leftHand": (0.4, 1.2, 1.5), "rightHand": (-0.4, 1.2, 1.5)}, 0.5),)
    plan = ShotPlan(Actor(curve="line:3"), request, priors.load("locomotion"), Character(), Fraction(30))
    solution = ShotSolution(motion, Status(Outcome.DONE), Ledger(), way=plan_way(request), reaches=reaches, met=met)
    done = PlayedShot(plan, solution)
    shot = stage_actor(done, colour="teal", start_seconds=2.0)
    assert (shot.colour, shot.start_seconds, shot.motion) == ("teal", 2.0, motion)
    assert [mark.seconds for mark in shot.wishes.marks] == [
        (1.5, 2.0),
        (1.5, 2.0),
        (0.5, 0.7),
        pytest.approx((2.0, 2.1)),
        pytest.approx((2.5, 2.6)),
    ]
    assert shot.wishes.marks[1].surface.vertices.mean(axis=0) == pytest.approx([-0.4, 1.2, 1.5])
    hips = motion.root_position[60, ::2]
    assert np.abs(shot.wishes.marks[3].surface.vertices[:25, [0, 2]].mean(axis=0) - hips.numpy()).max() < 0.02
    (pose,) = shot.wishes.poses
    torch.testing.assert_close(pose.root_position, motion.root_position[32:33])
    assert len(build_obstacles([done, done])) == 1, "each obstacle once"
