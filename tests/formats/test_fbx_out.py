"""FBX out: joints, names, rate and mesh are read back as they were written; without Blender a line with what to do."""

import os
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from blender_session import PYTHON, needs_blender
from fbx_maker import make_fbx
from helpers import generator, random_motion, run, walk

from mapctl import formats, rotations
from mapctl.errors import RequestError
from mapctl.formats import fbx_out
from mapctl.formats.character import build_skinned_body
from mapctl.skeleton import CANONICAL

ufbx = pytest.importorskip("ufbx", reason="needs ufbx: pip install 'mapctl[fbx]'")
METRES, DEGREES = 1e-5, 0.01


@pytest.fixture
def blender(monkeypatch):
    monkeypatch.setenv(fbx_out.BLENDER, str(PYTHON))


def assert_same(found, motion):
    """Same joints, same frames, and every joint where it was."""
    assert sorted(found.skeleton.names) == sorted(motion.skeleton.names)
    assert (found.fps, found.num_frames) == (motion.fps, motion.num_frames)
    order = order_of(found, motion)
    np.testing.assert_allclose(found.joint_positions()[:, order], motion.joint_positions(), rtol=0, atol=METRES)
    turned = rotations.multiply(found.joint_rotations()[:, order], rotations.inverse(motion.joint_rotations()))
    assert float(rotations.to_rotation_vector(turned).norm(dim=-1).rad2deg().max()) < DEGREES


def order_of(found, motion):
    """Indices of the motion's joints in what was found, where limbs come one after the other."""
    return [found.skeleton.index(name) for name in motion.skeleton.names]


def rest_of(motion):
    """The motion's skeleton at rest, at the origin."""
    still = motion.slice(0, 1)
    quats = torch.zeros_like(still.local_quat_xyzw)
    quats[..., 3] = 1.0
    return replace(still, root_position=torch.zeros(1, 3).double(), local_quat_xyzw=quats, moving_offsets={})


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("fps", [Fraction(30000, 1001), Fraction(120000, 1001), Fraction(50)])
def test_a_motion_is_read_back_with_a_body_that_its_joints_carry(blender, fps, tmp_path):
    skeleton = replace(CANONICAL, end_offsets={"head": (0.0, 0.2, 0.01), "leftToes": (0.01, -0.01, 0.1)})
    motion = replace(move(random_motion(skeleton)), fps=fps)
    formats.save(motion, tmp_path / "some walk.fbx")
    found = formats.load(tmp_path / "some walk.fbx")
    assert_same(found, motion)
    assert list(found.source.animations) == ["some walk"]
    order = order_of(found, motion)
    assert set(found.moving_offsets) == {order[joint] for joint in motion.moving_offsets}
    assert found.skeleton.end_offsets.keys() == motion.skeleton.end_offsets.keys()
    for name, end in motion.skeleton.end_offsets.items():
        assert found.skeleton.end_offsets[name] == pytest.approx(end, abs=METRES)
    rest = rest_of(motion)
    stands = formats.load_rest(tmp_path / "some walk.fbx").joint_positions()[:, order]
    np.testing.assert_allclose(stands, rest.joint_positions(), rtol=0, atol=METRES)
    body, mesh = build_skinned_body(motion)[1], formats.load_mesh(tmp_path / "some walk.fbx")
    vertices, _ = body.pose(rest.joint_positions()[0].numpy(), np.tile(np.eye(3), (motion.num_joints, 1, 1)))
    np.testing.assert_allclose(mesh.vertices, vertices, rtol=0, atol=METRES)
    np.testing.assert_allclose(mesh.rgba, body.rgba, rtol=0, atol=0.01)
    assert tables(mesh)[:, order] == pytest.approx(tables(body), abs=1e-6)


def tables(mesh):
    """Shares (n, joints) of the joints that carry each vertex."""
    shares = np.zeros((len(mesh.vertices), len(mesh.rest)))
    np.add.at(shares, (np.arange(len(shares))[:, None], mesh.joints), mesh.weights)
    return shares


KINDS = {
    "z-up": {"z_up": True},
    "inches": {"unit_cm": 2.54, "z_up": True, "version": 7100},
    "posed": {"posed": True, "z_up": True, "scale": (2.0, 2.0, 2.0)},
    "no-skin": {"skin": False, "rate": 120},
}


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_character_keeps_its_joints_and_its_mesh(blender, kind, tmp_path):
    """Its file is text, which Blender imports since 4.5."""
    make_fbx(tmp_path / "hero.fbx", **KINDS[kind])
    hero = formats.load(tmp_path / "hero.fbx")
    motion = move(hero)
    try:
        formats.save(motion, tmp_path / "out.fbx")
    except RequestError as error:
        pytest.skip(str(error)) if "ASCII" in str(error) else pytest.fail(str(error))
    check_character(tmp_path / "hero.fbx", tmp_path / "out.fbx", motion, mesh=kind != "no-skin")


@needs_blender
@pytest.mark.slow
def test_motion_is_put_on_the_users_own_file(blender, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    walk(12).save("hero.fbx")
    walk(30).save("walk.bvh")
    assert run("convert", "walk.bvh", "out.npz", "--rig", "hero.fbx") == 0
    assert run("convert", "walk.bvh", "out.fbx", "--rig", "hero.fbx") == 0
    check_character(tmp_path / "hero.fbx", tmp_path / "out.fbx", formats.load("out.npz"))
    motion = move(formats.load("hero.fbx"))
    formats.save(motion, "moved.fbx")
    check_character(tmp_path / "hero.fbx", tmp_path / "moved.fbx", motion)


def move(motion):
    """The same character in other poses, with joints that travel in their parents: one at the tip of the parent's bone
    as Blender draws it, and one beside it."""
    random, skeleton = generator(), motion.skeleton
    above = max(k for k in range(1, motion.num_joints) if skeleton.offsets[k][1] > 0.99 * skeleton.offsets[k].norm())

    def draw(*shape):
        return torch.randn(*shape, 3, generator=random, dtype=torch.float64)

    return replace(
        motion,
        root_position=draw(7),
        local_quat_xyzw=rotations.from_rotation_vector(0.3 * draw(7, motion.num_joints)),
        moving_offsets={k: skeleton.offsets[k] + 0.05 * draw(7) for k in (above, motion.num_joints - 1)},
    )


def check_character(hero, out, motion, *, mesh=True):
    """The file has the motion alone, and otherwise what the character's has."""
    found = formats.load(out)
    assert_same(found, motion)
    assert list(found.source.animations) == [out.stem]
    before, after = formats.load_rest(hero), formats.load_rest(out)
    np.testing.assert_allclose(after.joint_positions(), before.joint_positions(), rtol=0, atol=METRES)
    if mesh:
        before, after = formats.load_mesh(hero), formats.load_mesh(out)
        np.testing.assert_allclose(after.vertices, before.vertices, rtol=0, atol=METRES)
        np.testing.assert_array_equal(after.faces, before.faces)
        np.testing.assert_allclose(after.rgba, before.rgba, rtol=0, atol=0.01)
        assert tables(after) == pytest.approx(tables(before), abs=1e-6)


def test_a_rate_that_ufbx_does_not_list_is_read(tmp_path):
    make_fbx(tmp_path / "a.fbx", rate=120)
    text = (tmp_path / "a.fbx").read_text()
    assert '"TimeMode", "enum", "", "",1\n' in text
    (tmp_path / "a.fbx").write_text(text.replace('"TimeMode", "enum", "", "",1\n', '"TimeMode", "enum", "", "",18\n'))
    assert formats.load(tmp_path / "a.fbx").fps == Fraction(120000, 1001)


def test_without_blender_a_line_has_the_remedy(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    walk(4).save("in.bvh")
    monkeypatch.setattr(fbx_out, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(fbx_out.BLENDER, raising=False)
    (tmp_path / "takes").mkdir()
    make_fbx(tmp_path / "takes" / "a.fbx", frames=2)
    for words in (("in.bvh", "out.fbx"), ("takes", "out", "--to", ".fbx")):
        assert run("convert", *words) == 2
        assert "install it from blender.org and put its program on PATH" in capsys.readouterr().err
    monkeypatch.setenv(fbx_out.BLENDER, "nowhere/blender")
    assert run("convert", "in.bvh", "out.fbx") == 2
    assert "MAPCTL_BLENDER names nowhere/blender, which is no program" in capsys.readouterr().err
    assert not (tmp_path / "out.fbx").exists()


@pytest.mark.skipif(os.name == "nt", reason="its stub is a script of the shell")
@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("echo noise; echo 'Blender imports the character without its joint' >&2; exit 3", "without its joint"),
        ("exit 11", "ends with status 11"),
        ("exit 0", "ends with status 0"),
        ("kill -9 $$", "ends with status -9"),
    ],
)
def test_what_blender_cannot_do_is_one_line_and_nothing_is_written(does, message, tmp_path, monkeypatch):
    stub = tmp_path / "blender"
    stub.write_text(f"#!/bin/sh\n{does}\n")
    stub.chmod(0o755)
    monkeypatch.setenv(fbx_out.BLENDER, str(stub))
    with pytest.raises(RequestError, match=message) as caught:
        formats.save(walk(4), tmp_path / "a.fbx")
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["blender"]
