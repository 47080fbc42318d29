"""Robots: the model as MuJoCo has it, derivatives against differences, limits that hold, feet that stand, files."""

import json
from dataclasses import replace
from fractions import Fraction
from functools import reduce

import numpy as np
import pytest
import torch
from helpers import generator, run, walk
from robot_maker import RANGES, list_joints, make_mjcf, make_urdf

import mapctl
from mapctl import formats, rotations
from mapctl.commands.drive import Driver
from mapctl.errors import FileFormatError, RequestError
from mapctl.retarget.carry import retarget_motion
from mapctl.robots import files, model, plausibility
from mapctl.robots import retarget as solver
from mapctl.robots.following import DELAY_FRAMES, RobotFollower
from mapctl.robots.retarget import RobotMotion, observe, retarget_to_robot
from mapctl.streaming.sender import encode_frame


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("robots")


@pytest.fixture(scope="module")
def robot(folder):
    return model.load(make_mjcf(folder / "small.xml"))


@pytest.fixture(scope="module")
def walked(robot):
    return retarget_to_robot(walk(90), robot)[0]


def random_pose(robot, frames=4):
    """A motion with random base and angles within limits."""
    share = torch.rand(frames, len(robot.joints), generator=generator(1), dtype=torch.float64)
    vectors = torch.randn(frames, 3, generator=generator(2), dtype=torch.float64)
    position = torch.randn(frames, 3, generator=generator(3), dtype=torch.float64)
    base = rotations.rotation_vector_to_matrix(vectors)
    stand = torch.zeros(frames, 2, dtype=torch.bool)
    return RobotMotion(robot, Fraction(30), position, base, robot.low + share * (robot.high - robot.low), stand)


@pytest.mark.parametrize("make", [make_mjcf, make_urdf])
def test_links_limits_and_soles_are_those_of_the_model(make, tmp_path):
    found = model.load(make(tmp_path / "small.xml" if make is make_mjcf else tmp_path / "small.urdf"))
    assert list(found.joints) == [name for name, _ in list_joints()]
    ranges = np.array([RANGES[name.removeprefix("left_").removeprefix("right_")] for name in found.joints])
    waist = found.joints.index("waist_yaw")
    kept = [joint for joint in range(len(ranges)) if joint != waist]
    np.testing.assert_allclose(torch.stack([found.low, found.high], dim=1)[kept], ranges[kept], atol=1e-9)
    names = found.rigmap.joint_names
    assert (names["hips"], names["leftFoot"], names["rightLowerLeg"]) == (
        "pelvis",
        "left_ankle_roll_link",
        "right_knee_link",
    )
    np.testing.assert_allclose(found.soles[0][:, 2], -0.045, atol=1e-9)
    assert float(found.speed[0]) == (np.inf if make is make_mjcf else 12.0)


def test_links_are_where_mujoco_has_them(robot):
    pose = random_pose(robot)
    at, world = pose.chain_links()
    mujoco = model.import_mujoco()
    data = mujoco.MjData(robot.model)
    for frame in range(len(pose.angles)):
        data.qpos[:3] = pose.position[frame]
        data.qpos[3:7] = rotations.from_matrix(pose.orientation[frame]).roll(1)
        data.qpos[7:] = pose.angles[frame]
        mujoco.mj_kinematics(robot.model, data)
        for link in robot.bodies:
            body = data.body(robot.skeleton.names[link])
            np.testing.assert_allclose(at[frame, link], body.xpos, atol=1e-9)
            np.testing.assert_allclose(world[frame, link] @ robot.zero[link], body.xmat.reshape(3, 3), atol=1e-9)


def test_gradient_is_that_of_the_cost(robot):
    """Against central differences of the cost, whose residuals are smooth there."""
    seen = observe(retarget_motion(walk(8), robot.character).motion, robot)
    pose = random_pose(robot, 8)
    near = solver.start_search(robot, seen, Fraction(30))
    pose = replace(near, angles=near.angles + 0.1 * pose.angles, position=near.position + 0.01)
    system, step = solver._System.of(pose, seen), 1e-5

    def cost_at(frame, unknown, change):
        moved = replace(pose, position=pose.position.clone(), angles=pose.angles.clone())
        if unknown < 3:
            moved.position[frame, unknown] += change
        elif unknown < 6:
            vector = torch.zeros(3, dtype=torch.float64)
            vector[unknown - 3] = change
            turned = pose.orientation.clone()
            turned[frame] = rotations.rotation_vector_to_matrix(vector) @ turned[frame]
            moved = replace(moved, orientation=turned)
        else:
            moved.angles[frame, unknown - 6] += change
        return solver._System.of(moved, seen).cost

    for frame, unknown in ((0, 1), (3, 2), (4, 8), (7, 9), (2, 15), (5, 20)):
        slope = (cost_at(frame, unknown, step) - cost_at(frame, unknown, -step)) / (2 * step)
        assert float(system.gradient[frame, unknown]) == pytest.approx(-slope / 2, rel=2e-3, abs=1e-2)


def test_a_walk_stays_within_limits_with_feet_that_stand(robot, walked):
    assert bool(((walked.angles >= robot.low) & (walked.angles <= robot.high)).all())
    seen = observe(retarget_motion(walk(90), robot.character).motion, robot)
    points = walked.find_points(seen.links, seen.points)
    stays = walked.contacts[1:] & walked.contacts[:-1]
    assert float(stays.double().mean()) > 0.15
    slide = 30 * points[:, seen.tips].diff(dim=0).norm(dim=-1)[stays]
    assert float(slide.mean()) < 0.01
    assert float((points - seen.positions).norm(dim=-1)[:, seen.tips].mean()) < 0.02
    soles = walked.find_points(robot.corner_links, torch.cat(robot.soles))
    assert float(soles[..., 2].min()) > -0.02
    assert float(walked.position[-1, 0] - walked.position[0, 0]) > 1.0  # X ahead


def test_motion_is_smoother_than_frames_alone(robot, walked):
    """The same targets without a prior of jerk: each frame alone."""
    jerk = solver._JERKS
    seen = observe(retarget_motion(walk(30), robot.character).motion, robot)
    start = solver.start_search(robot, seen, Fraction(30))
    together = solver.minimise(start, seen, 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "_JERKS", tuple(1e6 * value for value in jerk))
        alone = solver.minimise(start, seen, 0)
    assert float(together.angles.diff(n=3, dim=0).abs().mean()) < 0.7 * float(
        alone.angles.diff(n=3, dim=0).abs().mean()
    )


def test_soles_stay_over_the_floor(robot):
    """Of a motion whose targets, loose ones, are 5 cm under it."""
    seen = observe(retarget_motion(walk(20), robot.character).motion, robot)
    seen = replace(seen, positions=seen.positions - torch.tensor([0, 0, 0.05]))
    seen = replace(seen, position_weights=seen.position_weights.clamp_max(0.03**-2))
    found = solver.minimise(solver.start_search(robot, seen, Fraction(30)), seen, 0)
    assert float(found.find_points(robot.corner_links, torch.cat(robot.soles))[..., 2].min()) > -0.02


def test_speeds_of_joints_hold(folder):
    path = make_mjcf(folder / "slow.xml")
    path.with_suffix(".toml").write_text("speed = 2.5\n")
    slow = model.load(path)
    clip = walk(60)
    found = retarget_to_robot(clip, slow)[0]
    assert float((30 * found.angles.diff(dim=0)).abs().max()) <= 2.5 + 1e-9
    follower, parts = RobotFollower(slow, clip.skeleton), list[torch.Tensor]()
    for first in range(0, 60, 3):
        part = follower.push(clip.root_position[first : first + 3], clip.local_quat_xyzw[first : first + 3])
        parts += [] if part is None else [part.angles]
    assert float((30 * torch.cat(parts).diff(dim=0)).abs().max()) <= 2.5 + 1e-9


def test_windows_join_without_a_seam(robot, monkeypatch):
    """Searches that go on to the minimum, so that nothing but the windows differs."""
    monkeypatch.setattr(solver, "_CONVERGED", 1e-6)
    monkeypatch.setattr(solver, "_ITERATIONS", 100)
    whole = retarget_to_robot(walk(150), robot)[0]
    monkeypatch.setattr(solver, "_WINDOW", 70)
    parts = retarget_to_robot(walk(150), robot)[0]
    assert parts.angles.shape == whole.angles.shape
    assert float((parts.angles - whole.angles).abs().max()) < 0.1
    assert float(parts.angles.diff(n=2, dim=0).abs().max()) < 1.3 * float(whole.angles.diff(n=2, dim=0).abs().max())


def test_links_are_matched_whatever_their_names_and_a_table_overrules(folder):
    numbers = {}
    path = make_mjcf(folder / "strange.xml", rename=lambda name: f"part{numbers.setdefault(name, len(numbers))}")
    plain = model.load(make_mjcf(folder / "plain.xml")).rigmap.joint_names
    found = model.load(path).rigmap.joint_names
    for joint, link in plain.items():
        name = link.removesuffix("_link")
        assert found[joint] == (link.replace(name, f"part{numbers[name]}") if name in numbers else link)
    knee = found["leftLowerLeg"]
    path.with_suffix(".toml").write_text(f'[links]\nleftFoot = "{knee}"\n')
    with pytest.raises(FileFormatError, match="has no shape; give the corners"):
        model.load(path)
    path.with_suffix(".toml").write_text("speeds = 3\n")
    with pytest.raises(FileFormatError, match="allowed: links, speed, soles"):
        model.load(path)


@pytest.mark.parametrize(
    ("name", "write", "fault"),
    [
        ("broken.xml", lambda path: path.write_text("<mujoco><worldbody>"), "MuJoCo"),
        ("slide.xml", lambda path: make_mjcf(path, joint="slide"), "only hinges"),
        ("bare.xml", lambda path: make_mjcf(path, shapes=False), "corners of its sole under"),
        (
            "box.xml",
            lambda path: path.write_text('<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>'),
            "no link",
        ),
    ],
)
def test_what_is_no_robot_is_refused_in_one_line(name, write, fault, tmp_path):
    write(tmp_path / name)
    with pytest.raises(FileFormatError, match=fault) as caught:
        model.load(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("quat", "back"),
    [("1 0 0 1", "1 0 0 0"), ("1 1 0 0", "1 -1 0 0"), ("1 0 1 0", "1 0 -1 0"), ("1 1 1 1", "1 -1 0 0")],
    ids=["heading", "rolled", "pitched", "rolled, heading"],
)
@pytest.mark.parametrize("base", ["<freejoint/>", ""])
def test_the_base_may_have_any_frame_and_heading(quat, back, base, robot, tmp_path):
    """Quaternions of the base, and of the links below it that leave but a heading."""
    text = make_mjcf(tmp_path / "turned.xml").read_text().replace('pos="0 0 0.8"', f'pos="0 0 0.8" quat="{quat}"')
    text = text.replace("<freejoint/>", f'{base}<frame quat="{back}">').replace(
        "</body></world", "</frame></body></world"
    )
    (tmp_path / "turned.xml").write_text(text)
    turned = model.load(tmp_path / "turned.xml")
    torch.testing.assert_close(turned.axes, robot.axes, rtol=0, atol=1e-9)
    torch.testing.assert_close(turned.skeleton.offsets, robot.skeleton.offsets, rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.cat(turned.soles).sum(0), torch.cat(robot.soles).sum(0), rtol=0, atol=1e-9)


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_the_shortest_motions_are_retargeted(frames, robot, walked, tmp_path):
    found = retarget_to_robot(walk(90).slice(0, frames), robot)[0]
    assert found.angles.shape == (frames, 21)
    assert float((found.angles - walked.angles[:frames]).abs().max()) < 0.3
    assert len(plausibility.assess(replace(found, fps=Fraction(1, 4)))) == frames
    files.save(found, tmp_path / "short.npz")
    with np.load(tmp_path / "short.npz") as arrays:
        assert all(np.isfinite(arrays[name]).all() for name in ("joint_vel", "body_ang_vel_w"))


def test_frames_may_come_many_at_once(robot):
    clip, follower, counts = walk(90), RobotFollower(robot, walk(2).skeleton), list[int]()
    for first, stop in ((0, 10), (10, 50), (50, 90)):
        found = follower.push(clip.root_position[first:stop], clip.local_quat_xyzw[first:stop])
        counts.append(0 if found is None else len(found.angles))
    assert counts == [4, 40, 40]


def test_feet_that_stand_stay_from_push_to_push(robot):
    clip, follower = walk(90), RobotFollower(robot, walk(2).skeleton)
    pushed = [follower.push(clip.root_position[k : k + 3], clip.local_quat_xyzw[k : k + 3]) for k in range(0, 90, 3)]
    first, *others = [part for part in pushed if part is not None]
    whole = reduce(RobotMotion.join, others, first)
    stays = whole.contacts[1:] & whole.contacts[:-1]
    slide = 30 * whole.find_tips().diff(dim=0)[..., :2].norm(dim=-1)[stays]
    assert float(slide.max()) < 0.02


def test_a_trunk_of_one_joint_turns_as_the_chest(robot):
    seen = observe(retarget_motion(walk(8), robot.character).motion, robot)
    names = [robot.skeleton.names[link] for link in seen.links]
    assert float(seen.orientation_weights[0, names.index("waist_yaw_link")]) > 0
    assert "head" not in names  # is fixed to it


def test_joints_need_no_names(robot, tmp_path):
    text = make_mjcf(tmp_path / "bare.xml").read_text()
    (tmp_path / "bare.xml").write_text(text.replace('<joint name="left_knee"', "<joint"))
    bare = model.load(tmp_path / "bare.xml")
    assert bare.joints[3] == "joint4"
    fine, same = (plausibility.assess(random_pose(one)) for one in (robot, bare))
    assert fine == same


def test_speeds_that_are_no_numbers_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match="velocity of joints"):
        model.load(make_urdf(tmp_path / "small.urdf", speed="fast"))


@pytest.mark.parametrize("corners", ["[[0.1, 0]]", "[]"])
def test_corners_of_a_sole_are_at_least_three_points(corners, folder):
    path = make_mjcf(folder / "corners.xml")
    path.with_suffix(".toml").write_text(f"[soles]\nleft_ankle_roll_link = {corners}\n")
    with pytest.raises(FileFormatError, match="soles"):
        model.load(path)


@pytest.mark.parametrize("header", [True, False])
def test_a_csv_gives_the_same_motion_back(header, robot, walked, tmp_path):
    files.save(walked, tmp_path / "walk.csv", header=header)
    rows = (tmp_path / "walk.csv").read_text().splitlines()
    assert len(rows) == 90 + header
    assert all(len(row.split(",")) == 7 + 21 for row in rows)
    assert float(files.build_rows(walked)[:, 6].abs().min()) > 0.9  # the scalar is the last: the base is upright
    found = files.load_csv(tmp_path / "walk.csv", robot, Fraction(30))
    torch.testing.assert_close(found.angles, walked.angles, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.orientation, walked.orientation, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.position, walked.position, rtol=0, atol=1e-6)
    assert float((found.contacts == walked.contacts).double().mean()) > 0.9


@pytest.mark.parametrize(
    ("text", "fault"),
    [("1,2,3\n", "3 columns"), ("a;b\n", "no table"), (",".join(["1"] * 28), "unit quaternion"), ("", "empty")],
)
def test_another_csv_is_refused_in_one_line(text, fault, robot, tmp_path):
    (tmp_path / "other.csv").write_text(text)
    with pytest.raises(FileFormatError, match=fault):
        files.load_csv(tmp_path / "other.csv", robot, Fraction(30))


def test_arrays_hold_velocities_of_what_they_hold(robot, walked, tmp_path):
    files.save(walked, tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as arrays:
        assert list(arrays["joint_names"]) == list(robot.joints)
        moved = arrays["body_pos_w"][11] - arrays["body_pos_w"][9]
        np.testing.assert_allclose(arrays["body_lin_vel_w"][10], 15 * moved, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(arrays["body_quat_w"], axis=-1), 1, atol=1e-9)
        assert arrays["contacts"].shape == (90, 2)
    with pytest.raises(RequestError, match=r"\.csv or \.npz"):
        files.save(walked, tmp_path / "walk.txt")


def test_what_is_implausible_is_measured(robot, walked):
    fine = plausibility.find_worst(plausibility.assess(walked))
    assert (fine.limit_excess_deg, fine.self_contact_cm) == (0, 0)
    assert fine.slide_cm_s < 3
    bent = walked.angles.clone()
    bent[40, 3] = robot.high[3] + 0.1
    crossed = bent.clone()
    crossed[50] = 0
    crossed[50, [1, 7]] = torch.tensor([-0.1, 0.1], dtype=torch.float64)  # both legs inwards
    strange = replace(walked, angles=crossed, position=walked.position - torch.tensor([0.0, 0.0, 0.05]))
    found = plausibility.assess(strange)
    assert found[1].limit_excess_deg == pytest.approx(np.degrees(0.1), rel=1e-6)
    assert found[1].self_contact_cm > 1
    assert found[2].self_contact_cm == 0
    assert all(second.sole_low_cm < -3 for second in found)
    assert found[1].speed_rad_s > fine.speed_rad_s


def test_the_command_writes_and_reads_a_robot(folder, robot, tmp_path, capsys):
    xml, source = folder / "small.xml", tmp_path / "walk.bvh"
    formats.save(walk(60), source)
    out, report = tmp_path / "walk.csv", tmp_path / "report.json"
    run("convert", source, out, "--robot", xml, "--header", "--fps", 50, "--report", report)
    assert "limits held" in capsys.readouterr().out
    assert out.read_text().startswith("x,y,z,qx,qy,qz,qw,left_hip_yaw,")
    found = json.loads(report.read_text())
    assert len(found["seconds"]) == 2
    assert found["changes"]["scale"] < 1
    run("convert", out, tmp_path / "back.bvh", "--robot", xml, "--fps-in", 50, "--rig", "canonical")
    back = mapctl.load(tmp_path / "back.bvh")
    assert (back.num_frames, float(back.fps)) == (len(out.read_text().splitlines()) - 1, 50)
    assert 0.4 < float(back.root_position[:, 1].mean()) < 0.9  # Y up, on the robot's legs


def test_a_robots_own_file_is_resampled_not_solved_again(folder, robot, walked, tmp_path):
    files.save(walked, tmp_path / "walk.csv")
    run("convert", tmp_path / "walk.csv", tmp_path / "walk.npz", "--robot", folder / "small.xml", "--fps", 60)
    with np.load(tmp_path / "walk.npz") as arrays:
        np.testing.assert_allclose(
            arrays["joint_pos"][:-1:2], walked.angles[: len(arrays["joint_pos"]) // 2], atol=1e-5
        )
        np.testing.assert_allclose(arrays["body_pos_w"][0, 0], walked.position[0], atol=1e-5)


def test_a_folder_becomes_a_robots_files(folder, tmp_path, capsys):
    (tmp_path / "clips").mkdir()
    formats.save(walk(20), tmp_path / "clips" / "walk.bvh")
    words = ("convert", tmp_path / "clips", tmp_path / "out", "--robot", folder / "small.xml")
    assert run(*words, "--to", ".csv") == 0
    assert len((tmp_path / "out" / "walk.csv").read_text().splitlines()) == 20
    assert run(*words) == 2
    assert "--robot is for a robot's motion" in capsys.readouterr().err


def test_a_header_is_for_robots_alone(tmp_path, capsys):
    formats.save(walk(20), tmp_path / "walk.bvh")
    assert run("convert", tmp_path / "walk.bvh", tmp_path / "out.bvh", "--header") == 2
    assert "--robot" in capsys.readouterr().err


def test_a_robot_follows_a_stream_as_it_would_the_whole(robot):
    """Frames over VMC, three at a time: limits, feet and the pose are those of a clip that is known whole."""
    clip, driver, rows = walk(90), Driver(robot), []
    for frame in range(90):
        pose = (clip.root_position[frame].numpy(), clip.local_quat_xyzw[frame].numpy())
        rows += driver.take(encode_frame(clip.skeleton, *pose, frame / 30))
    assert len(rows) == 90 - DELAY_FRAMES
    numbers = torch.tensor([message.arguments for message in rows], dtype=torch.float64)
    np.testing.assert_allclose(numbers[:, 0], np.arange(84) / 30, atol=1e-6)
    whole = retarget_to_robot(clip, robot)[0]
    angles = numbers[:, 8:]
    assert bool(((angles >= robot.low) & (angles <= robot.high)).all())
    assert float((numbers[30:, 1:4] - whole.position[30:84]).norm(dim=1).mean()) < 0.03
    assert float((angles - whole.angles[:84])[30:].abs().mean()) < 0.1
    assert float(angles.diff(n=3, dim=0).abs().mean()) < 2 * float(whole.angles.diff(n=3, dim=0).abs().mean())


def test_balance_is_the_distance_from_the_sole_beyond_a_corner_too(robot, walked):
    corners = torch.cat(robot.soles)[None]
    stands = replace(walked.slice(0, 1), contacts=torch.tensor([[True, False]]))
    farthest = robot.soles[0].amax(dim=0)
    for away, expected in (((0.3, 0.4, 1.0), 0.5), ((0.2, -0.01, 1.0), 0.2), ((-0.01, -0.01, 1.0), 0.0)):
        centre = (farthest + torch.tensor(away, dtype=torch.float64))[None]
        assert float(plausibility._measure_balance(stands, corners, centre)[0]) == pytest.approx(expected, abs=1e-6)
