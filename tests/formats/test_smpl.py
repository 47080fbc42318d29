"""SMPL parameters: read by the models' own formulas, refused in a line, written as they came."""

import math

import numpy as np
import pytest
import torch
from helpers import make_smpl_parameters, run, walk
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
        ({"poses": np.zeros((0, 72)), "trans": np.zeros((0, 3))}, "poses holds no frames"),
        ({"mocap_framerate": 0.0}, "frames per second"),
        ({"mocap_framerate": "fast"}, "frames per second"),
        ({"poses": np.array([None])}, "sound"),
    ],
)
def test_broken_parameters_are_refused_in_a_line(changed, message, tmp_path):
    with pytest.raises(FileFormatError, match=message):
        formats.load(write(tmp_path / "a.npz", **changed))


def test_a_pickle_is_refused_with_what_to_do(tmp_path):
    np.save(tmp_path / "a.npy", np.array({"pose": 1}), allow_pickle=True)
    for name in ("a.pkl", "a.npy"):
        with pytest.raises(FileFormatError, match="save its poses, trans and mocap_framerate as an"):
            formats.load(tmp_path / name)


def split(poses, given, **more):
    """The parameters of SMPL-X in parts, as the package smplx takes them."""
    parts = {"global_orient": poses[:, :1], "body_pose": poses[:, 1:22], "jaw_pose": poses[:, 22:23]}
    parts |= {"leye_pose": poses[:, 23:24], "reye_pose": poses[:, 24:25]}
    parts |= {"left_hand_pose": poses[:, 25:40], "right_hand_pose": poses[:, 40:]}
    return parts | {"transl": given["trans"], "betas": given["betas"]} | more


def to_matrices(poses):
    return Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)


def to_tensors(arrays):
    return {key: torch.as_tensor(value) for key, value in arrays.items()}


LAYOUTS = {  # joints, ending, and the file's content of rotation vectors (frames, joints, 3) and the file of AMASS
    "flat": (55, ".npz", lambda p, g: {key: v.reshape(len(v), -1) for key, v in split(p, g).items() if key != "betas"}),
    "joints": (55, ".npz", split),
    "matrices": (55, ".npz", lambda p, g: split(to_matrices(p), g)),
    "smpl": (
        24,
        ".npz",
        lambda p, g: {"global_orient": p[:, 0], "body_pose": to_matrices(p[:, 1:]), "transl": g["trans"]},
    ),
    "wham": (24, ".npz", lambda p, g: {"pose_world": p.reshape(len(p), 72), "trans_world": g["trans"], "pose": p * 0}),
    "whole matrices": (52, ".npz", lambda p, g: {"poses": to_matrices(p), "trans": g["trans"]}),
    "gvhmr": (
        55,
        ".pt",
        lambda p, g: {
            "smpl_params_incam": to_tensors(split(0 * p, g)),
            "smpl_params_global": to_tensors(split(p, g, betas=np.tile(g["betas"], (len(p), 1)))),
            "K_fullimg": torch.eye(3),
            "net_outputs": {"static": [torch.zeros(2)]},
        },
    ),
    "nested": (55, ".pth", lambda p, g: {"epoch": 3, "result": {"smplx": to_tensors(split(p, g))}}),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read_as_that_of_amass(layout, tmp_path, capsys):
    joints, ending, arrange = LAYOUTS[layout]
    path = write(tmp_path / "amass.npz", joints, "y", mocap_framerate=30.0)
    given = dict(np.load(path))
    content, file = arrange(given["poses"].reshape(9, joints, 3), given), tmp_path / f"a{ending}"
    np.savez(file, **content) if ending == ".npz" else torch.save(content, file)
    motion, wanted = formats.load(file), formats.load(path)
    assert (motion.fps, motion.skeleton.names) == (wanted.fps, wanted.skeleton.names)
    np.testing.assert_allclose(motion.joint_positions(), wanted.joint_positions(), atol=1e-9)
    np.testing.assert_allclose(motion.local_quat_xyzw, wanted.local_quat_xyzw, atol=1e-9)
    if ending == ".pt":
        np.testing.assert_allclose(motion.source.betas, given["betas"], atol=1e-12)
    assert capsys.readouterr().err.count("30 frames a second are assumed") == 1
    assert formats.load(file, fps=25).fps == 25


def test_one_frame_may_be_without_its_axis(tmp_path):
    parameters = {key: value.numpy() for key, value in make_smpl_parameters(1).items()}
    np.savez(tmp_path / "a.npz", **parameters)
    np.savez(tmp_path / "b.npz", **parameters | {"body_pose": parameters["body_pose"].reshape(21, 3)})
    motions = [formats.load(tmp_path / name) for name in ("a.npz", "b.npz")]
    np.testing.assert_array_equal(motions[0].joint_positions(), motions[1].joint_positions())


def test_a_world_of_gvhmr_has_y_up_however_the_body_lies(tmp_path):
    parameters = make_smpl_parameters(4) | {"transl": torch.zeros(4, 3)}
    parameters["global_orient"] = torch.tensor([[math.pi / 2, 0.0, 0.0]]).repeat(4, 1)
    torch.save({"smpl_params_global": parameters}, tmp_path / "a.pt")
    lying = formats.load(tmp_path / "a.pt")
    assert float(lying.joint_positions()[..., 1].std()) < 0.2
    torch.save(parameters, tmp_path / "b.pt")
    assert float(formats.load(tmp_path / "b.pt").joint_positions()[..., 1].std()) > 0.3, "without the key the trunk is"


def test_a_camera_that_has_y_down_is_turned(tmp_path, capsys):
    path = write(tmp_path / "a.npz", up="y")
    given = dict(np.load(path))
    turn = Rotation.from_euler("x", 180, degrees=True)
    down = given["poses"].copy()
    down[:, :3] = (turn * Rotation.from_rotvec(down[:, :3])).as_rotvec()
    np.savez(tmp_path / "b.npz", **given | {"poses": down, "trans": turn.apply(given["trans"])})
    motion, wanted = formats.load(tmp_path / "b.npz"), formats.load(path)
    assert "Y is down, as in a camera's frame" in capsys.readouterr().err
    np.testing.assert_allclose(motion.joint_positions(), wanted.joint_positions(), atol=1e-9)
    smpl.save(motion, tmp_path / "c.npz")
    np.testing.assert_allclose(np.load(tmp_path / "c.npz")["trans"], turn.apply(given["trans"]), atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: {"global_orient": np.zeros((3, 3))}, "holds objects, whose reading may run code"),
        (lambda: Rotation.identity(), "holds objects, whose reading may run code"),
        (lambda: {"layer.weight": torch.zeros(3, 3)}, "holds no SMPL parameters"),
        (lambda: torch.zeros(9, 72), "holds no SMPL parameters"),
        (
            lambda: make_smpl_parameters(3) | {"body_pose": torch.zeros(3, 60)},
            r"body_pose has .* \(3, 63\) or \(3, 69\)",
        ),
        (lambda: make_smpl_parameters(3) | {"left_hand_pose": torch.zeros(3, 12)}, "left_hand_pose has"),
        (lambda: make_smpl_parameters(3) | {"transl": torch.zeros(4, 3)}, "transl has"),
        (lambda: {"global_orient": torch.zeros(3, 3), "transl": torch.zeros(3, 3)}, "lacks the keys body_pose"),
        (lambda: make_smpl_parameters(3) | {"transl": "none"}, "transl has"),
    ],
)
def test_a_file_of_torch_without_plain_parameters_is_refused_in_a_line(content, message, tmp_path):
    torch.save(content(), tmp_path / "a.pt")
    with pytest.raises(FileFormatError, match=message) as caught:
        formats.load(tmp_path / "a.pt")
    assert "\n" not in str(caught.value)


def test_a_rate_is_requested_only_where_the_file_has_none(tmp_path, capsys):
    torch.save(make_smpl_parameters(4), tmp_path / "a.pt")
    assert run("convert", tmp_path / "a.pt", tmp_path / "a.bvh", "--fps-in", "25") == 0
    assert float(formats.load(tmp_path / "a.bvh").fps) == 25
    assert "assumed" not in capsys.readouterr().err
    walk(4).save(tmp_path / "own.npz")
    for path in (write(tmp_path / "b.npz"), tmp_path / "own.npz"):
        assert run("convert", path, tmp_path / "b.bvh", "--fps-in", "25") == 2
        assert "has a frame rate of its own" in capsys.readouterr().err


def write_model(path):
    """Write a body model drawn at random, of 40 vertices; return its arrays."""
    random = np.random.default_rng(1)
    vertices, shapes = random.normal(0, 1, (40, 3)), random.normal(0, 0.1, (40, 3, 10))
    regressor = random.dirichlet(np.ones(40), 24)
    np.savez(path, v_template=vertices, shapedirs=shapes, J_regressor=regressor)
    return vertices, shapes, regressor


def test_missing_bones_are_noted_unless_a_model_gives_them(tmp_path, capsys):
    write_model(tmp_path / "model.npz")
    path, out = write(tmp_path / "a.npz"), tmp_path / "a.bvh"
    assert run("convert", path, out, "--smpl-model", tmp_path / "model.npz") == 0
    assert "have no bones" not in capsys.readouterr().err
    assert run("convert", path, out) == 0
    assert "have no bones" in capsys.readouterr().err


def test_a_body_model_gives_the_bones_and_the_floor(tmp_path):
    vertices, shapes, regressor = write_model(tmp_path / "model.npz")
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
