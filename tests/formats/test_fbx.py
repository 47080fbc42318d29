"""FBX in: joints, rest pose and skin are where the files' makers have them; and the sandbox that reads them."""

import re
import runpy
from fractions import Fraction

import numpy as np
import pytest

pytest.importorskip("ufbx", reason="needs ufbx: pip install 'mapctl[fbx]'")

from fbx_maker import JOINTS, make_fbx

from mapctl import cli, formats
from mapctl.errors import FileFormatError
from mapctl.formats import sandbox

KINDS = {
    "z-up": {"z_up": True},
    "inches": {"unit_cm": 2.54, "z_up": True, "version": 7100},
    "posed": {"posed": True, "z_up": True, "scale": (2.0, 2.0, 2.0)},
    "no-skin": {"skin": False, "rate": 120},
}


NEAR = dict(rtol=0, atol=1e-9)


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def in_order(motion):
    """Positions (frames, joints, 3) in the maker's order; those of a file go down one limb after the other."""
    assert sorted(motion.skeleton.names) == sorted(JOINTS)
    return motion.joint_positions()[:, [motion.skeleton.index(joint) for joint in JOINTS]].numpy()


def test_a_clip_is_where_fbx_has_it(kind, tmp_path):
    result = make_fbx(tmp_path / "a.fbx", **KINDS[kind])
    motion = formats.load(tmp_path / "a.fbx")
    assert (motion.fps, motion.num_frames) == (KINDS[kind].get("rate", 30), 6)
    assert motion.source.animation == "Take 001"
    np.testing.assert_allclose(in_order(motion), result.positions, **NEAR)
    assert not motion.moving_offsets


def test_the_rest_pose_is_that_of_the_skin(kind, tmp_path):
    result = make_fbx(tmp_path / "a.fbx", **KINDS[kind])
    np.testing.assert_allclose(in_order(formats.load_rest(tmp_path / "a.fbx"))[0], result.bound, **NEAR)
    if KINDS[kind].get("skin", True):
        mesh = formats.load_mesh(tmp_path / "a.fbx")
        np.testing.assert_allclose(mesh.vertices, result.vertices, **NEAR)
        np.testing.assert_allclose(mesh.weights.sum(axis=1), 1.0)
    else:
        with pytest.raises(FileFormatError, match="'Armature' carries no triangles"):
            formats.load_mesh(tmp_path / "a.fbx")


def test_the_rate_of_television(tmp_path):
    path = tmp_path / "a.fbx"
    make_fbx(path)
    path.write_text(path.read_text().replace('P: "TimeMode", "enum", "", "",6', 'P: "TimeMode", "enum", "", "",8'))
    assert formats.load(path).fps == Fraction(30000, 1001)


@pytest.mark.slow
def test_takes_and_armatures_are_chosen_by_name(tmp_path):
    path = tmp_path / "a.fbx"
    make_fbx(path, takes=("Walk", "Run"))
    assert [formats.load(f"{path}{choice}").source.animation for choice in ("", "#/Run", "#Armature/Walk")] == [
        "Walk",
        "Run",
        "Walk",
    ]
    assert not np.allclose(in_order(formats.load(path)), in_order(formats.load(f"{path}#/Run")))
    with pytest.raises(FileFormatError, match="has no animation 'Hop'; it has 'Walk', 'Run'"):
        formats.load(f"{path}#/Hop")
    make_fbx(path, names=("Hero", "Villain"))
    with pytest.raises(FileFormatError, match=r"has 2 armatures: 'Hero', 'Villain'; choose one, as a.fbx#Hero"):
        formats.load(path)
    assert formats.load(f"{path}#Villain").num_frames == 6


def test_without_takes_it_is_the_rest_pose(tmp_path):
    make_fbx(tmp_path / "a.fbx", takes=())
    assert formats.load(tmp_path / "a.fbx").num_frames == 1


def test_indices_of_a_mesh_that_point_at_nothing_are_one_warning(tmp_path, capsys):
    """As 3ds Max writes them: -1 for corners without a texture coordinate."""
    path = tmp_path / "a.fbx"
    result = make_fbx(path)
    layer = """
        LayerElementUV: 0 {
            MappingInformationType: "ByPolygonVertex"
            ReferenceInformationType: "IndexToDirect"
            UV: *2 { a: 0,0
            }
            UVIndex: *COUNT { a: INDICES
            }
        }
        Layer: 0 {
            LayerElement:  {
                Type: "LayerElementUV"
                TypedIndex: 0
            }
        }"""
    found = re.search(r"\t\tPolygonVertexIndex: \*(\d+) .*?}\n?", path.read_text(), re.DOTALL)
    assert found is not None
    count = int(found[1])
    layer = layer.replace("COUNT", str(count)).replace("INDICES", ",".join(["-1", *["0"] * (count - 1)]))
    path.write_text(path.read_text().replace(found[0], f"{found[0].rstrip()}{layer}\n"))
    np.testing.assert_allclose(in_order(formats.load(path)), result.positions, **NEAR)
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"{path}: 1 of its meshes' indices point at nothing" in err
    np.testing.assert_allclose(formats.load_mesh(path).vertices, result.vertices, **NEAR)


def test_motion_is_read_where_a_mesh_is_broken(tmp_path, capsys):
    path = tmp_path / "a.fbx"
    result = make_fbx(path)
    path.write_text(re.sub(r"(Vertices: \*\d+ \{\s*a: )[^,]*,", r"\1", path.read_text(), count=1))
    np.testing.assert_allclose(in_order(formats.load(path)), result.positions, **NEAR)
    assert capsys.readouterr().err == f"mapctl: {path}: its meshes are broken; its joints and motion are read\n"
    with pytest.raises(FileFormatError, match="is no sound FBX file"):
        formats.load_mesh(path)


STOP = '"LocalStop", "KTime", "Time", "",'


SCALING = '"Lcl Scaling", "", "A",'


BAD = {
    "no fbx": (r".*", "hello", "is no sound FBX file"),
    "cut off": (r"Connections:.*", "", "has no limb nodes"),
    "broken": (r"a: .*", "a: 1,2,", "is no sound FBX file"),
    "a version to come": ("FBX 7.4.0", "FBX 9.9.0", "is FBX 9.9, read are 3 to 7.7"),
    "no limbs": (r"Objects:.*", "", "has no limb nodes and no skin"),
    "negative scale": (f"{SCALING}1,1,1", f"{SCALING}-1,1,1", "negative"),
    "too long": (STOP + r"\d+", f"{STOP}{10**18}", "allowed are 33554432"),
}
"""Pattern in a sound file, what stands in its place, and words of the message."""


@pytest.mark.parametrize("fault", BAD)
def test_bad_files_are_refused_in_one_line(fault, tmp_path, capfd):
    path = tmp_path / "a.fbx"
    make_fbx(path, skin=False)
    pattern, instead, words = BAD[fault]
    path.write_text(re.sub(pattern, instead, path.read_text(), count=1, flags=re.DOTALL))
    assert cli.main(["convert", str(path), str(tmp_path / "out.bvh")]) == 2
    given = capfd.readouterr()
    assert given.err.count("\n") == 1, given.err
    assert words in given.err
    assert not given.out
    assert not (tmp_path / "out.bvh").exists()


def test_the_sandbox_bounds_time_and_memory_and_refuses_what_crashes(tmp_path, monkeypatch):
    path = tmp_path / "a.fbx"
    make_fbx(path)
    monkeypatch.setattr(sandbox, "MEMORY_BYTES", 2**26)
    with pytest.raises(FileFormatError, match=r"memory|is broken"):
        formats.load(path)
    monkeypatch.setattr(sandbox, "SECONDS", -0.5)
    with pytest.raises(FileFormatError, match=r"cannot be read within \d seconds"):
        formats.load(path)
    monkeypatch.undo()
    crash = tmp_path / "crash.py"
    crash.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(FileFormatError, match="ends by SIGSEGV"):
        sandbox.call(runpy.run_path, crash)
