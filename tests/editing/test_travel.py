"""Travel taken out, or put on a root joint, on any rig."""

import pytest
import torch
from helpers import walk
from rigs_to_edit import RIGS, on_rig

import mapctl
from mapctl import editing, rotations
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.editing.travel import GroundTransform, fit_ground_transform, move_by_share


def upright(motion):
    return RiggedMotion.of(motion).motion


@pytest.mark.parametrize("name", RIGS)
def test_in_place_the_hips_stay_and_all_rotations_too(name):
    motion = on_rig(name)
    still = editing.remove_travel(motion)
    hips = RiggedMotion.of(still).position("hips")
    spread = hips.amax(dim=0) - hips.amin(dim=0)
    assert float(spread[::2].max()) < 0.05
    before = RiggedMotion.of(motion).position("hips")
    assert float((before.amax(dim=0) - before.amin(dim=0))[::2].max()) > 2.0
    torch.testing.assert_close(hips[:, 1], before[:, 1])
    torch.testing.assert_close(hips[0], before[0])
    assert torch.equal(still.local_quat_xyzw, motion.local_quat_xyzw)


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_with_travel_on_the_root_nothing_else_moves(name):
    motion = on_rig(name, walk(75, cadence=1.0, turn_rate=0.4))
    rooted = editing.move_travel_to_root(motion)
    names = motion.skeleton.names
    has_root = RIGS[name].root is not None
    assert rooted.skeleton.names == (names if has_root else ("root", *names))
    same = [rooted.skeleton.index(joint) for joint in names][int(has_root) :]
    torch.testing.assert_close(
        rooted.joint_positions()[:, same], motion.joint_positions()[:, int(has_root) :], atol=1e-9, rtol=0
    )
    root, hips = upright(rooted).root_position, RiggedMotion.of(motion).position("hips")
    assert float(root[:, 1].abs().max()) < 1e-9
    assert float((root - hips)[:, ::2].norm(dim=-1).max()) < 0.08
    turned = RiggedMotion.of(rooted)
    heading = rotations.unwrap_angle(rotations.split_heading(turned.canonical.joint_rotations()[:, 0])[0])
    world = turned.motion.joint_rotations()[:, 0]
    about = rotations.multiply(world, rotations.inverse(world[:1]).expand(world.shape))
    own = rotations.unwrap_angle(rotations.split_heading(about)[0])
    assert float((own - (heading - heading[0])).abs().max()) < 0.15
    assert float(rotations.split_heading(about)[1][:, [0, 2]].abs().max()) < 1e-9  # about the vertical alone


@pytest.mark.parametrize("name", ["fingers, twists, a sword", "Z up", "root on the ground"])
def test_a_file_with_a_root_is_read_back_and_keeps_its_unit(name, tmp_path):
    on_rig(name).save(tmp_path / "in.bvh")
    motion = mapctl.load(tmp_path / "in.bvh")
    rooted = editing.move_travel_to_root(motion)
    rooted.save(tmp_path / "out.bvh")
    again = mapctl.load(tmp_path / "out.bvh")
    torch.testing.assert_close(again.joint_positions(), rooted.joint_positions(), atol=1e-6, rtol=0)
    assert again.source.metres_per_unit == motion.source.metres_per_unit
    lines = [(tmp_path / file).read_text().split("\n") for file in ("in.bvh", "out.bvh")]
    left, right = (next(line.split()[-6:] for line in reversed(some) if line) for some in lines)
    assert left == right  # the last joint's numbers
    assert editing.move_travel_to_root(again).num_joints == again.num_joints


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-4, 0.7, -2.5])
def test_shares_add_up(turn):
    motion = walk(8)
    travel = GroundTransform(turn, (0.4, -1.1))
    one, two = torch.full((8,), 0.3).double(), torch.full((8,), 0.7).double()
    steps = move_by_share(move_by_share(motion, travel, one), travel, two)
    whole = move_by_share(motion, travel, one + two)
    torch.testing.assert_close(steps.joint_positions(), whole.joint_positions(), atol=1e-9, rtol=0)
    found = fit_ground_transform(motion.joint_positions(), whole.joint_positions())
    assert found.turn == pytest.approx(turn, abs=1e-9)
    assert found.shift_xz == pytest.approx(travel.shift_xz, abs=1e-9)
