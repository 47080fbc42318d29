"""The path predictor: its layers, what it sees, and what it does not."""

from dataclasses import replace

import pytest
import tiny_path
import torch
from helpers import walk

from mapctl import rotations
from mapctl.errors import CheckpointError, RequestError
from mapctl.features import LAYOUT, encode
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.kinematics import heading
from mapctl.protocols import PathPredictor
from priors import checkpoints, path
from priors.path import PathConfig


def local_motion(frames=90, **options):
    motion = walk(frames, **options)
    return LocalMotion.of_world(
        motion.joint_positions().float()[None], heading(motion.local_quat_xyzw[:, 0]).float()[None]
    )


def outputs(trajectory: RootTrajectory):
    return torch.cat([trajectory.steps_heading, trajectory.height[..., None], trajectory.contacts], dim=-1)


def test_a_motion_s_length_does_not_change_what_is_far_from_its_end():
    network, whole = tiny_path.network(), local_motion(330)
    part = LocalMotion(whole.places[:, :303], whole.turns[:, :303], whole.present[:, :303])
    one, other = outputs(network(whole))[:, :160], outputs(network(part))[:, :160]
    torch.testing.assert_close(one, other, atol=1e-6, rtol=0)
    assert network(part).height.shape == (1, 303)


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


def test_absent_frames_are_as_if_there_were_nothing():
    seen = local_motion(60)
    wild = seen.places.clone()
    wild[:, 40:] = 9.0
    present = seen.present.clone()
    present[:, 40:] = False
    network = tiny_path.network()
    one, other = (outputs(network(LocalMotion(places, seen.turns, present)))[:, :40] for places in (seen.places, wild))
    torch.testing.assert_close(one, other, atol=1e-6, rtol=0)


def test_steps_that_are_summed_up_lead_along_the_way_walked():
    motion = walk(80, turn_rate=0.7)
    features = encode(motion)[0][None]
    steps, height = LAYOUT.pick(features, "root_displacement_heading"), LAYOUT.pick(features, "root_height")[..., 0]
    told = RootTrajectory(steps, height, LAYOUT.pick(features, "contacts"))
    found = told.integrate(heading(motion.local_quat_xyzw[:, 0])[None])[0]
    wanted = motion.root_position.clone()
    wanted[:, ::2] -= wanted[0, ::2].clone()
    torch.testing.assert_close(found, wanted, atol=1e-9, rtol=0)


def test_an_anchored_step_keeps_a_joint_in_its_place():
    motion = walk(30, turn_rate=0.9)
    facing = heading(motion.local_quat_xyzw[:, 0])[None]
    seen = LocalMotion.of_world(motion.joint_positions()[None], facing)
    for joint in (15, 20, 4):
        steps = seen.anchored_steps()[..., joint, ::2]
        hips = RootTrajectory(steps, torch.zeros_like(facing), steps).integrate(facing)[0]
        held = rotations.rotate_about_y(seen.places[0, :, joint], facing[0]) + hips
        assert float(held[:, ::2].std(dim=0).max()) < 1e-9


def test_it_is_saved_and_loaded_and_no_other_kind_is(tmp_path):
    file = tiny_path.save_tiny_path(tmp_path / "path.safetensors")
    found = path.load(str(file))
    assert isinstance(found, PathPredictor)
    seen = local_motion(40)
    torch.testing.assert_close(
        outputs(found.predict(seen)), outputs(tiny_path.tiny_path().predict(seen)), atol=0.02, rtol=0.05
    )
    with pytest.raises(CheckpointError, match="a denoiser is no path"):
        path.load("denoiser")
    card = replace(tiny_path.card(), config={"width": 5})
    checkpoints.save(tiny_path.network().state_dict(), card, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="do not fit"):
        path.load(str(tmp_path / "other.safetensors"))
    with pytest.raises(RequestError, match="positive width"):
        PathConfig(width=0)


def test_the_bundled_one_knows_who_stands_and_how_far_a_walk_goes():
    predictor, motion = path.load(), walk(90)
    assert "Bandai" in predictor.card.licence or "NC" in predictor.card.licence
    stands = LocalMotion.of_world(motion.joint_positions().float()[None, :1].expand(1, 90, 21, 3), torch.zeros(1, 90))
    assert float(predictor.predict(stands).steps_heading.abs().max()) < 0.002
    facing = heading(motion.local_quat_xyzw[:, 0]).float()[None]
    walked = predictor.predict(LocalMotion.of_world(motion.joint_positions().float()[None], facing)).integrate(facing)
    # The toes of the made-up walk slide; a body that goes so walks ahead, at the pace of a stroll.
    assert 1.0 < float(walked[0, -1, 2]) < 4.0
    assert abs(float(walked[0, -1, 0])) < 0.2
    assert float((walked[0, :, 1] - motion.root_position[:, 1]).abs().max()) < 0.1
