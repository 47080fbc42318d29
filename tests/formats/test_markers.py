"""Positions of markers and joints: a known motion is read back from its markers, broken files are refused in a line."""

import json

import numpy as np
import pytest
import torch
from helpers import run, walk
from marker_files import WRITERS, Z_UP, mark, order_joints, write_csv, write_motive, write_trc

from mapctl import formats, rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import marker_fit, positions
from mapctl.skeleton import CANONICAL

ezc3d = pytest.importorskip("ezc3d")


def distances(motion, again):
    """Distances of joints, metres, (frames, joints)."""
    return (motion.joint_positions() - again.joint_positions()).norm(dim=-1)


@pytest.mark.parametrize("z_up", [False, True])
@pytest.mark.parametrize("ending", WRITERS)
def test_motion_is_read_back_from_its_markers(ending, z_up, tmp_path):
    motion, (writer, scale) = walk(40, fps=60), WRITERS[ending]
    labels, values = mark(motion)
    prefixed = [f"Bob:{label}" for label in labels] + ["Bob:LHipAngles"]
    values = np.concatenate([values, np.full_like(values[:, :1], 0.3)], axis=1)
    path = writer(tmp_path / f"a{ending}", prefixed, (values @ Z_UP if z_up else values) * scale)
    again = formats.load(path)
    assert (again.skeleton.names, float(again.fps), again.num_frames) == (CANONICAL.names, 60.0, 40)
    assert again.source.mean < 0.01
    assert again.source.unused == ("Bob:LHipAngles",)
    assert again.source.metres_per_unit == pytest.approx(1 / scale)
    apart = distances(motion, again)
    assert float(apart.mean()) < 0.025
    assert float(apart[:, CANONICAL.indices(["leftLowerLeg", "rightFoot", "leftHand", "hips"])].max()) < 0.05
    bend = CANONICAL.index("rightLowerLeg")
    knees = [rotations.to_rotation_vector(m.local_quat_xyzw[:, bend])[:, 0] for m in (motion, again)]
    assert float((knees[0] - knees[1]).abs().max()) < 0.2
    assert np.corrcoef(knees[0], knees[1])[0, 1] > 0.95


def test_poses_are_solved_from_markers_that_are_seen_and_lost_joints_are_reported(tmp_path):
    motion = walk(60, fps=60)
    labels, values = mark(motion)
    values[10:20, labels.index("LKNE")] = np.nan  # still solved: the thigh and the shank are seen
    arm = [labels.index(label) for label in ("LELB", "LWRA", "LWRB", "LFIN")]
    values[30:40, arm] = np.nan
    path = write_trc(tmp_path / "a.trc", labels, values * 1000)
    again, missing = formats.load_with_missing(path)
    assert float(distances(motion, again)[10:20, CANONICAL.index("leftLowerLeg")].max()) < 0.05
    lost = torch.zeros(60, 21, dtype=torch.bool)
    lost[30:40, CANONICAL.indices(["leftUpperArm", "leftLowerArm", "leftHand"])] = True
    assert torch.equal(missing.rotations, lost)
    assert not missing.positions.any()


def test_motive_and_plain_tables_hold_the_same_motion(tmp_path):
    labels, values = mark(walk(20, fps=60))
    plain = formats.load(write_csv(tmp_path / "a.csv", labels, values))
    motive = formats.load(write_motive(tmp_path / "b.csv", labels, values))
    assert plain.fps == motive.fps == 60
    np.testing.assert_allclose(plain.joint_positions(), motive.joint_positions(), atol=1e-4)


@pytest.mark.parametrize("named", [False, True])
def test_joints_of_an_array_are_read_by_their_number_or_by_names_beside_it(named, tmp_path, capsys):
    motion = walk(30)
    values = order_joints(motion)
    if named:
        keep = [n for n in range(22) if n != 6]
        values, names = values[:, keep], [positions.SETS["HumanML3D"][n] for n in keep]
        (tmp_path / "a.json").write_text(json.dumps({"names": names, "fps": 30}))
    np.save(tmp_path / "a.npy", values - values[:, :1])
    again = formats.load(tmp_path / "a.npy")
    shown = capsys.readouterr().err
    assert ("HumanML3D" in shown) != named
    assert ("30 frames a second" in shown) != named
    centred = [m.joint_positions() - m.joint_positions()[:, :1] for m in (motion, again)]
    legs = CANONICAL.indices(["leftLowerLeg", "rightFoot", "leftToes", "leftHand"])
    assert float((centred[0] - centred[1])[:, legs].norm(dim=-1).max()) < 0.05


def test_a_wrong_unit_is_found_by_the_size_of_the_body(tmp_path, capsys):
    labels, values = mark(walk(20, fps=60))
    again = formats.load(write_trc(tmp_path / "a.trc", labels, values, unit="mm"))
    assert again.source.metres_per_unit == 1.0
    assert "states a unit of 0.001 m" in again.source.unit_doubt
    assert run("info", str(tmp_path / "a.trc")) == 0
    assert "states a unit of 0.001 m" in capsys.readouterr().out
    assert formats.load(tmp_path / "a.trc", metres_per_unit=0.5).source.metres_per_unit == 0.5


def test_own_names_are_read_with_a_table_of_markers(tmp_path):
    motion = walk(30, fps=60)
    joints = [
        "leftUpperLeg",
        "leftLowerLeg",
        "leftFoot",
        "leftToes",
        "leftUpperArm",
        "leftLowerArm",
        "leftHand",
        "head",
    ]
    joints = list(dict.fromkeys(joint.replace("left", side) for joint in joints for side in ("left", "right")))
    values = motion.joint_positions()[:, CANONICAL.indices(joints)].numpy()
    labels = [f"q{n}" for n in range(len(joints))]
    path = write_trc(tmp_path / "a.trc", labels, values * 1000)
    with pytest.raises(FileFormatError, match=r"no markers of known names for leftUpperLeg.*--markers"):
        formats.load(path)
    table = tmp_path / "own.toml"
    table.write_text("".join(f'{joint} = ["{label}"]\n' for joint, label in zip(joints, labels, strict=True)))
    again = formats.load(path, markers=table)
    assert float(distances(motion, again)[:, CANONICAL.indices(joints)].mean()) < 0.02
    assert run("convert", str(path), str(tmp_path / "b.bvh"), "--markers", str(table)) == 0
    table.write_text('elbow = ["q1"]\n')
    with pytest.raises(FileFormatError, match="there is no such joint"):
        formats.load(path, markers=table)
    with pytest.raises(RequestError, match="for positions"):
        formats.load(tmp_path / "b.bvh", markers=table)


def test_legs_alone_are_a_body_whose_trunk_rests(tmp_path):
    motion = walk(30, fps=60)
    labels, values = mark(motion)
    legs = [
        n for n, label in enumerate(labels) if label[1:] in ("ASI", "PSI", "KNE", "ANK", "HEE", "TOE", "THI", "TIB")
    ]
    again, missing = formats.load_with_missing(
        write_trc(tmp_path / "a.trc", [labels[n] for n in legs], values[:, legs] * 1000)
    )
    assert not missing.rotations.any()
    assert float(distances(motion, again)[:, CANONICAL.indices(["leftFoot", "rightLowerLeg"])].max()) < 0.05
    others = [n for n in legs if labels[n][1:] != "ANK"]
    path = write_trc(tmp_path / "b.trc", [labels[n] for n in others], values[:, others] * 1000)
    with pytest.raises(FileFormatError, match="leftFoot, rightFoot"):
        formats.load(path)


def test_info_prints_the_fit_and_a_bad_fit_is_warned_about(tmp_path, capsys):
    labels, values = mark(walk(20, fps=60))
    path = write_trc(tmp_path / "a.trc", [*labels, "Wand"], np.concatenate([values, values[:, :1]], axis=1) * 1000)
    assert run("info", str(path)) == 0
    shown = capsys.readouterr().out
    assert f"markers: {len(labels)} are 0." in shown
    assert "not used (1): Wand" in shown
    noisy = values + np.random.default_rng(0).normal(0, 0.2, values.shape)
    formats.load(write_trc(tmp_path / "b.trc", labels, noisy * 1000))
    assert "from the markers on average" in capsys.readouterr().err


BROKEN = {
    "a.trc": b"PathFileType\t4\t(X/Y/Z)\tBTK\nDataRate\tCameraRate\n",
    "b.trc": b"PathFileType\t4\nDataRate\n100\nFrame#\tTime\tLASI\n\tX1\n\n1\t0\tone\t2\t3\n",
    "c.c3d": b"\x02P" + bytes(600),
    "d.c3d": b"no C3D at all",
    "e.csv": b"time,speed\n0,1\n",
    "f.npy": b"\x93NUMPY junk",
    "g.csv": b"",
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_in_a_line(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(BROKEN[name])
    with pytest.raises(FileFormatError) as refused:
        formats.load(path)
    assert "\n" not in str(refused.value)


def test_arrays_that_are_no_joints_are_refused(tmp_path):
    for values, message in ((np.zeros((3, 4)), "shape"), (np.ones((3, 5, 3)), "5 joints without names")):
        np.save(tmp_path / "a.npy", values)
        with pytest.raises(FileFormatError, match=message):
            formats.load(tmp_path / "a.npy")


def test_c3d_without_its_package_is_refused_with_a_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ezc3d", None)
    monkeypatch.delitem(__import__("sys").modules, "mapctl.formats.c3d", raising=False)
    (tmp_path / "a.c3d").write_bytes(b"x")
    with pytest.raises(FileFormatError, match=r"pip install 'mapctl\[c3d\]'"):
        formats.load(tmp_path / "a.c3d")


def test_every_marker_of_the_table_belongs_to_one_segment():
    table, joints = marker_fit._read_table()
    for name, landmark in {**table, **joints}.items():
        assert landmark.of == landmark.on or CANONICAL.parents[landmark.of] == landmark.on, name
    assert table["lkne"].at == (0.055, 0.0, 0.0)
    assert table["rkne"].at == (-0.055, 0.0, 0.0)
