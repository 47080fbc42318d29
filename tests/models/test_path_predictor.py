"""The path predictor: its layers, what it sees, and what it does not."""

from dataclasses import replace

import tiny_path
import torch
from helpers import walk

import priors
from mapctl import rotations
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.kinematics import heading


def local_motion(frames=90, **options):
    motion = walk(frames, **options)
    return LocalMotion.of_world(
        motion.joint_positions().float()[None], heading(motion.local_quat_xyzw[:, 0]).float()[None]
    )


def outputs(trajectory: RootTrajectory):
    return torch.cat([trajectory.steps_heading, trajectory.height[..., None], trajectory.contacts], dim=-1)


def test_where_a_walk_is_and_whither_it_goes_changes_nothing():
    motion, predictor = walk(60, turn_rate=0.5), tiny_path.tiny_path()
    turn = rotations.about_y(torch.tensor(2.0, dtype=torch.float64)).expand(60, 4)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    root = rotations.rotate(turn, motion.root_position) + torch.tensor([40.0, 0.0, -7.0], dtype=torch.float64)
    moved = replace(motion, root_position=root, local_quat_xyzw=quats)
    found = [
        predictor.predict(
            LocalMotion.of_world(
                each.joint_positions().float()[None], heading(each.local_quat_xyzw[:, 0]).float()[None]
            )
        )
        for each in (motion, moved)
    ]
    torch.testing.assert_close(outputs(found[0]), outputs(found[1]), atol=1e-4, rtol=0)


def test_a_mirrored_walk_goes_the_mirrored_way():
    seen, predictor = local_motion(60, turn_rate=0.4), tiny_path.tiny_path(seed=3)
    torch.testing.assert_close(
        outputs(predictor.predict(seen.mirrored()).mirrored()), outputs(predictor.predict(seen)), atol=1e-5, rtol=0
    )
    assert float(
        (outputs(predictor.network(seen.mirrored()).mirrored()) - outputs(predictor.network(seen))).abs().max()
    )


def test_the_bundled_one_knows_standing_and_how_far_a_walk_goes():
    predictor, motion = priors.load_path(), walk(90)
    assert "Bandai" in predictor.card.licence or "NC" in predictor.card.licence
    stands = LocalMotion.of_world(motion.joint_positions().float()[None, :1].expand(1, 90, 21, 3), torch.zeros(1, 90))
    assert float(predictor.predict(stands).steps_heading.abs().max()) < 0.002
    facing = heading(motion.local_quat_xyzw[:, 0]).float()[None]
    walked = predictor.predict(LocalMotion.of_world(motion.joint_positions().float()[None], facing)).integrate(facing)
    # The toes of the made-up walk slide; a body that goes so walks ahead, at the pace of a stroll.
    assert 1.0 < float(walked[0, -1, 2]) < 4.0
    assert abs(float(walked[0, -1, 0])) < 0.2
    assert float((walked[0, :, 1] - motion.root_position[:, 1]).abs().max()) < 0.1
