"""Stairs and platforms under another body: as high in scale, or as high in metres; and feet that stand on them."""

from dataclasses import replace

import pytest
import torch
from performers import FEET, HIPJOINTS, TOES, Performer

from mapctl.motion import Motion
from mapctl.retarget.carry import GroundMode, RiggedCharacter, find_ground, retarget_canonical, retarget_motion
from mapctl.skeleton import leg_length

CLIMBS = Performer(stair=0.10, upright=0.9)
OTHERS = {"small": Performer(size=0.8, toe_height=0.03), "tall": Performer(size=1.2, toe_height=0.05)}


def climb() -> tuple[Motion, RiggedCharacter]:
    """Up a stair from the floor, after a while on the floor that tells how high toes rest."""
    return CLIMBS.walks(100), Performer().body()


def stands(motion: Motion, clip: Motion) -> torch.Tensor:
    """Toe heights by frame and foot where the clip's feet stand, nan elsewhere."""
    still = clip.joint_positions()[:, TOES].diff(dim=0, prepend=clip.joint_positions()[:1, TOES]).norm(dim=-1) < 1e-6
    return torch.where(still, motion.joint_positions()[:, TOES, 1], torch.nan)


@pytest.mark.parametrize("mode", ["fit", "keep"])
@pytest.mark.parametrize("name", OTHERS)
def test_steps_are_as_high_as_asked(mode: GroundMode, name):
    clip, giver = climb()
    body = OTHERS[name].body()
    done = retarget_canonical(clip, giver, body, ground=mode)
    scale = leg_length(body.leveled) / leg_length(clip.skeleton)
    factor = scale if mode == "fit" else 1.0
    over = stands(clip, clip) - Performer().toe_height
    got = stands(done.motion, clip) - OTHERS[name].toe_height
    high = over > 0.05
    assert int(high.sum()) > 40
    assert float((got - factor * over)[high].abs().max()) < 0.012
    assert done.changes.feet_missed.frames == 0


@pytest.mark.parametrize("mode", ["fit", "keep"])
def test_feet_on_stairs_do_not_slide(mode: GroundMode):
    clip, giver = climb()
    for name in OTHERS:
        done = retarget_canonical(clip, giver, OTHERS[name].body(), ground=mode).motion
        moved = done.joint_positions()[:, TOES].diff(dim=0).norm(dim=-1)
        still = clip.joint_positions()[:, TOES].diff(dim=0).norm(dim=-1) < 1e-6
        still[1:] &= still[:-1].clone()
        assert float(moved[still].median()) < 1e-3
        assert float(moved[still].quantile(0.95)) < 4e-3


@pytest.mark.parametrize(("height", "kept"), [(0.045, True), (0.02, False)])
def test_a_low_platform_is_kept_only_where_that_is_asked(height, kept):
    """From 3 cm on: less may be the height of the toe joints."""
    walk, body = Performer().walks(), OTHERS["tall"].body()
    clip = replace(walk, root_position=walk.root_position + torch.tensor([0.0, height, 0.0], dtype=torch.float64))
    low = {
        mode: float(retarget_motion(clip, body, ground=mode).motion.joint_positions()[:, TOES, 1].quantile(0.05))
        for mode in ("fit", "keep")
    }
    assert low["fit"] == pytest.approx(0.05, abs=0.008)
    assert low["keep"] == pytest.approx(0.05 + (height if kept else 0.0), abs=0.008)


def test_a_foot_that_is_held_up_stands_on_nothing():
    """At the height of a kick, and while the body is not over it."""
    up = torch.full((60,), -1.2, dtype=torch.float64)
    clip = Performer().stands(turned={HIPJOINTS[0]: up, FEET[0]: -up})
    ground = find_ground(clip, Performer().body().stance)
    assert ground.height.abs().max() == 0
