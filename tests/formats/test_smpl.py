"""SMPL parameters: read by the models' own formulas, refused in a line, written as they came."""

import math

import numpy as np
import pytest
import torch
from helpers import run, walk
from scipy.spatial.transform import Rotation

from mapctl import formats
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import smpl

UP = {"z": Rotation.from_euler("x", 90, degrees=True), "y": Rotation.identity()}
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


def write(path, joints=24, up="z", seed=0, **changed):
    """Write parameters of a standing body with small rotations of all joints, as estimators do."""
    random = np.random.default_rng(seed)
    poses = random.normal(0, 0.2, (9, joints, 3))
    poses[:, 0] = (UP[up] * Rotation.from_rotvec(random.normal(0, 0.2, (9, 3)))).as_rotvec()
    arrays = {"poses": poses.reshape(9, -1), "trans": random.normal(0, 1, (9, 3)), "betas": random.normal(0, 1, 10)}
    arrays |= {"mocap_framerate": 25.0, "gender": "female"} | changed
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


@pytest.mark.parametrize("up", UP)
@pytest.mark.parametrize("joints", smpl.JOINTS)
def test_parameters_pose_the_tree_and_are_written_as_they_came(joints, up, tmp_path):
    path = write(tmp_path / "a.npz", joints, up)
    motion, given = formats.load(path), np.load(path)
    assert (float(motion.fps), motion.num_joints, motion.num_frames) == (25.0, joints, 9)
    poses = given["poses"].reshape(9, joints, 3)
    if joints == 24:
        assert list(motion.skeleton.parents) == PARENTS
    names = motion.skeleton.names
    world = UP[up].inv() * Rotation.from_rotvec(poses[:, 0])
    for name in ("L_Hip", "L_Knee", "L_Ankle"):
        world = world * Rotation.from_rotvec(poses[:, names.index(name)])
    toe, ankle = (motion.joint_positions()[:, names.index(name)].numpy() for name in ("L_Foot", "L_Ankle"))
    bone = motion.skeleton.offsets[names.index("L_Foot")].numpy()
    np.testing.assert_allclose(toe - ankle, world.apply(bone), atol=1e-9)
    lower = motion.joint_positions()[:, [names.index("L_Foot"), names.index("R_Foot")], 1].amin(dim=1)
    assert 0.0 < float(lower.median()) < 0.06
    smpl.save(motion, tmp_path / "b.npz")
    back = np.load(tmp_path / "b.npz")
    for key in ("poses", "trans", "betas", "mocap_framerate", "gender"):
        if back[key].dtype.kind == "f":
            np.testing.assert_allclose(back[key], given[key], atol=1e-9)
        else:
            assert back[key] == given[key]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"trans": None}, "trans"),
        ({"trans": np.zeros((4, 3))}, "trans has"),
        ({"poses": np.zeros((9, 66))}, "poses has"),
        ({"poses": np.full((9, 72), np.nan)}, "no number"),
        ({"poses": np.zeros((0, 72)), "trans": np.zeros((0, 3))}, "poses has"),
        ({"mocap_framerate": None}, "mocap_framerate"),
        ({"mocap_framerate": 0.0}, "frames per second"),
        ({"mocap_framerate": "fast"}, "frames per second"),
        ({"poses": np.array([None])}, "sound"),
    ],
)
def test_broken_parameters_are_refused_in_a_line(changed, message, tmp_path):
    with pytest.raises(FileFormatError, match=message):
        formats.load(write(tmp_path / "a.npz", **changed))


def test_a_pickle_is_refused_with_what_to_do(tmp_path):
    with pytest.raises(FileFormatError, match="save its poses, trans and mocap_framerate as an"):
        formats.load(tmp_path / "a.pkl")


def test_a_body_model_gives_the_bones_and_the_floor(tmp_path):
    random = np.random.default_rng(1)
    vertices, shapes = random.normal(0, 1, (40, 3)), random.normal(0, 0.1, (40, 3, 10))
    regressor = random.dirichlet(np.ones(40), 24)
    np.savez(tmp_path / "model.npz", v_template=vertices, shapedirs=shapes, J_regressor=regressor)
    path = write(tmp_path / "a.npz")
    motion, given = smpl.fit_bones(formats.load(path), tmp_path / "model.npz"), np.load(path)
    rest = np.einsum("jv,vc->jc", regressor, vertices + np.einsum("vcs,s->vc", shapes, given["betas"]))
    hips = UP["z"].inv().apply(given["trans"] + rest[0])
    np.testing.assert_allclose(motion.root_position.numpy(), hips, atol=1e-9)
    np.testing.assert_allclose(motion.skeleton.offsets[4].numpy(), rest[4] - rest[1], atol=1e-9)
    smpl.save(motion, tmp_path / "b.npz")
    np.testing.assert_allclose(np.load(tmp_path / "b.npz")["trans"], given["trans"], atol=1e-9)
    np.savez(tmp_path / "model.npz", v_template=vertices, shapedirs=shapes, J_regressor=regressor[:20])
    with pytest.raises(FileFormatError, match="no model of 24 joints"):
        smpl.fit_bones(formats.load(path), tmp_path / "model.npz")
    with pytest.raises(RequestError, match="bones of its own"):
        smpl.fit_bones(walk(4), tmp_path / "model.npz")


def test_convert_writes_parameters_of_any_rig_and_of_its_own_bvh(tmp_path):
    path = write(tmp_path / "a.npz")
    given = np.load(path)
    run("convert", path, tmp_path / "a.bvh")
    run("convert", tmp_path / "a.bvh", tmp_path / "b.npz", "--as", "smpl")
    back = np.load(tmp_path / "b.npz")
    turned = (
        Rotation.from_rotvec(back["poses"].reshape(-1, 3)) * Rotation.from_rotvec(given["poses"].reshape(-1, 3)).inv()
    )
    assert math.degrees(turned.magnitude().max()) < 0.01
    away = back["trans"] - given["trans"]
    assert np.ptp(away, axis=0).max() < 1e-4, "but for the height of the floor, which the file does not have"
    walk(12).save(tmp_path / "walk.bvh")
    run("convert", tmp_path / "walk.bvh", tmp_path / "c.npz", "--as", "smpl")
    motion = formats.load(tmp_path / "c.npz")
    ends = walk(12).root_position[[0, -1]][:, [0, 2]].diff(dim=0).norm()
    assert float(motion.root_position[[0, -1]][:, [0, 2]].diff(dim=0).norm()) == pytest.approx(float(ends), rel=0.2)
    assert torch.isfinite(motion.joint_positions()).all()
