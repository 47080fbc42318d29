"""Table 1: networks that tell rotations by other numbers, trained alike and measured on poses they do not see."""

import json
import math

import pytest
import torch
from helpers import corpus, generator, run, walk

from mapctl import joint_ranges, kinematics, rotations
from mapctl.features import encode
from mapctl.skeleton import CANONICAL
from priors.tweening.representations import (
    IkErrors,
    IkSettings,
    list_representations,
    measure_inverse_kinematics,
    measure_mean_pose,
    place_poses,
    train_inverse_kinematics,
    turn_at_random,
)

BY_NAME = {each.name: each for each in list_representations()}
CONSTRAINED = "Euler angles in their ranges, 6-D hips"


def numbers_of(name, local):
    """The numbers of a representation for these rotations, by the way back that it does not share."""
    if name == "quaternions":
        return -3 * rotations.from_matrix(local).flatten(1)  # of any length and sign
    if name == "6-D":
        return rotations.to_six(local).flatten(1)
    if name == "Euler angles":
        axes = rotations.euler_axes(["YXZ", *["XZY"] * 20])
        return rotations.to_euler(local, axes).flatten(1)
    ranges = joint_ranges.load()
    low, high = ranges.low.to(local), ranges.high.to(local)
    middle = (2 * ranges.to_angles(local[:, 1:]) - low - high) / (high - low)
    return torch.cat([rotations.to_six(local[:, 0]), torch.atanh(middle.clamp(-0.99999, 0.99999)).flatten(1)], dim=1)


@pytest.mark.parametrize("name", BY_NAME)
def test_told_its_own_numbers_each_one_makes_the_pose(name):
    local = rotations.to_matrix(walk(30, turn_rate=3.0).local_quat_xyzw).float()
    wanted = kinematics.positions_from_matrices(CANONICAL, local)
    rows = numbers_of(name, local)
    assert rows.shape == (30, BY_NAME[name].rows)
    assert float((BY_NAME[name].place(rows) - wanted).norm(dim=-1).max()) < (0.02 if name == CONSTRAINED else 1e-4)


def test_poses_of_features_are_those_of_the_motion_seen_along_its_heading():
    motion = walk(100, turn_rate=1.0)
    places = place_poses(encode(motion)[0].float())
    assert places.shape == (100, 21, 3)
    facing = rotations.split_heading(motion.local_quat_xyzw[:, 0])[0]
    own = rotations.rotate_about_y(motion.joint_positions() - motion.root_position[:, None], -facing[:, None])
    assert float((places - own).norm(dim=-1).max()) < 1e-5
    turned = turn_at_random(places, generator(3))
    assert torch.allclose(turned.norm(dim=-1), places.norm(dim=-1), atol=1e-5)
    assert torch.equal(turned[..., 1], places[..., 1])
    hands = turned[:, CANONICAL.index("leftHand")]
    assert float(torch.atan2(hands[:, 0], hands[:, 2]).std()) > 1.2  # all round: 1.8 if even


@pytest.mark.slow
def test_training_brings_it_near_and_a_seed_gives_the_same_network():
    places = place_poses(corpus(3).features)
    for representation in BY_NAME.values():
        first, last, again = (
            measure_inverse_kinematics(
                representation,
                train_inverse_kinematics(
                    representation, places, IkSettings(steps=steps, batch=64, width=48, learning_rate=3e-3)
                ),
                places,
                seed=1,
            )
            for steps in (1, 40, 40)
        )
        assert last == again
        assert last.mean < 0.8 * first.mean
        assert last.mean < last.largest
    assert measure_mean_pose(places, places[:1].expand(5, -1, -1)).deviation > 0


def test_errors_are_of_all_joints_and_poses():
    found = IkErrors.of_distances(torch.tensor([[0.01, 0.02], [0.03, 0.06]]))
    assert (found.mean, found.largest) == (pytest.approx(3.0), pytest.approx(6.0))
    assert found.deviation == pytest.approx(math.sqrt(3.5))


@pytest.mark.slow
def test_the_command_trains_each_and_tells_what_the_ranges_leave_out(tmp_path, capsys):
    data = tmp_path / "data"
    data.mkdir()
    for number in range(5):
        walk(80, cadence=0.8 + 0.1 * number).save(data / f"walk-{number}.bvh")
    words = ["bench", "representation", "--data", data]
    assert run(*words, "--steps", "3", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["by"] for row in rows] == ["mean pose, told the heading", *BY_NAME, "nearest poses within the ranges"]
    assert all(0 < row["mean_cm"] < row["max_cm"] for row in rows[1:-1])
    assert 0 < rows[-1]["outside_percent"] < 20  # the made-up walks bend where nobody does
    assert 0 < rows[-1]["mean_cm"] < 2
    assert run(*words, "--steps", "0") == 2
    assert "steps" in capsys.readouterr().err
    assert run("bench", "representation", "--data", tmp_path / "gone") == 2
    assert "no such folder" in capsys.readouterr().err
