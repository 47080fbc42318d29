"""Targets of actors in films: marks are strong at their time, poses are bodies that one sees through."""

import numpy as np
import pytest
from helpers import moved
from scenes_walks import walk

from mapctl.mesh import colours
from scenes import renderers
from scenes.cameras import CameraSettings
from scenes.overlays import build_target
from scenes.renderers import Content, select_painter
from scenes.stage import Mark, Shot, Stage, Targets


def test_a_mark_is_strong_at_its_time_and_faint_at_others():
    target = build_target((0.4, 1.2, 1.0))
    momentary, held = Mark(target, (1.0, 1.0)), Mark(target, (1.5, 2.5))
    stage = Stage([Shot(walk(48, fps=12), start_seconds=1.0, targets=Targets([momentary, held]))])

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
def test_a_ghost_pose_is_seen_and_of_a_body_translucent(renderer):
    try:
        brush = select_painter(renderer)
    except renderers.NoGraphicsError:
        pytest.skip("no OpenGL without a window here")
    motion = walk(6, speed=0.0)
    beside = moved(motion.slice(2, 3), turn=0.0, shift=(0.7, 0.0))
    stage = Stage([Shot(motion, targets=Targets(poses=[beside, motion.slice(2, 3)]))])
    content = stage.content(2)
    assert len(content.veils) == 2
    view = stage.views(CameraSettings(azimuth_deg=0.0, elevation_deg=5.0, zoom=0.5), (160, 160))[0]
    plain = brush.paint(view, Content(content.ground, content.figures)).astype(float)
    seen = brush.paint(view, content).astype(float)
    changed = np.abs(seen - plain).max(axis=2) > 8
    red = colours.rgb(colours.TARGET) @ [1, -0.5, -0.5]
    assert (seen - plain)[changed].mean(axis=0) @ [1, -0.5, -0.5] / 255 > 0.1 * red
    shown = [0.7] if renderer == "stick" else [0.7, 0.0]  # sticks of an actor cover those of its ghost
    for position in (view.project(np.array([[x, 1.2, 0.0]])) for x in shown):
        column, row = np.rint(position[0, :2]).astype(int)
        around = changed[row - 4 : row + 5, column - 4 : column + 5]
        assert around.mean() > 0.7
        opaque = np.abs(seen[row, column] - 255 * colours.rgb(colours.TARGET)).max() <= 30
        assert opaque == (renderer == "stick")
    assert changed.mean() < 0.3
