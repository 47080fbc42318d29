"""BVH reading and writing against an independent reading of the format, over every channel layout."""

from dataclasses import replace
from fractions import Fraction
from itertools import product

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from turns import turn

from mapctl import formats, rotations
from mapctl.errors import RequestError
from mapctl.formats import bvh
from mapctl.formats.units import UNITS, guess_unit
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

AXES = "XYZ"
EULER_ORDERS = [order for order in product(range(3), repeat=3) if order[0] != order[1] != order[2]]
PLAIN = """HIERARCHY
ROOT hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT leftUpperLeg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT leftFoot
    {
      OFFSET 0 -80 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 0 10
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
1 90 3 10 20 30 1 2 3 0.1 -0.2 0.3
2 91 4 11 21 31 2 3 4 0.2 -0.3 100
"""


def world(tree, values):
    """World positions (frames, joints, 3) and matrices, straight from the definition of the channels."""
    positions, turns = (np.zeros((len(values), len(tree.names), 3)), np.zeros((len(values), len(tree.names), 3, 3)))
    for frame, row in enumerate(values):
        numbers = iter(row)
        for joint, parent in enumerate(tree.parents):
            position, rotation = np.array(tree.offsets[joint]), np.eye(3)
            for channel in tree.channels[joint]:
                axis, value = AXES.index(channel[0]), next(numbers)
                if channel.endswith("position"):
                    position[axis] = value
                else:
                    rotation = rotation @ turn(axis, value)
            up_place, up_turn = (positions[frame, parent], turns[frame, parent]) if joint else (0, np.eye(3))
            positions[frame, joint], turns[frame, joint] = up_place + up_turn @ position, up_turn @ rotation
    return positions, turns


def agrees(path, positions, turns, scale):
    """Within 0.01 mm and 0.001 degree, as files of 6 decimals allow."""
    motion = bvh.load(path)
    found = rotations.to_matrix(motion.joint_rotations()).numpy()
    angle = np.degrees(2 * np.arcsin(np.linalg.norm(found - turns, axis=(-1, -2)) / np.sqrt(8)))
    assert np.abs(motion.joint_positions().numpy() - positions * scale).max() < 1e-5
    assert angle.max() < 1e-3
    return motion


@st.composite
def channel_lists(draw):
    order = draw(st.sampled_from(EULER_ORDERS))[: draw(st.integers(0, 3))]
    positions = draw(st.permutations(range(3)))[: draw(st.sampled_from((0, 0, 1, 3)))]
    names = [AXES[a] + "position" for a in positions] + [AXES[a] + "rotation" for a in order]
    return tuple(names)


@st.composite
def files(draw):
    """A small tree of any shape and layout, a number of frames and a seed."""
    joints = draw(st.integers(1, 5))
    stack, parents = [], []
    for joint in range(joints):
        # Depth first: a parent is the last joint or one that encloses it.
        del stack[draw(st.integers(1, max(1, len(stack)))) :]
        parents.append(stack[-1] if stack else -1)
        stack.append(joint)
    channels = [draw(channel_lists()) for _ in range(joints)]
    channels[0] = channels[0] or ("Yrotation",)
    return parents, channels, draw(st.integers(1, 4)), draw(st.integers(0, 2**32 - 1))


def content(parents, channels, frames, seed):
    """Offsets and channel values for a drawn layout."""
    random, joints = np.random.default_rng(seed), len(parents)
    offsets = random.normal(0, 40, (joints, 3)).round(4)
    names, ends = tuple(f"joint{j}" for j in range(joints)), {joints - 1: (0.0, 5.0, 0.0)}
    offsets = tuple((x, y, z) for x, y, z in offsets.tolist())
    tree = bvh.Hierarchy(names, tuple(parents), offsets, tuple(channels), ends)
    values = random.uniform(-180, 180, (frames, len(tree.labels()))).round(4)
    return tree, values


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(files())
def test_any_layout_is_read_as_defined_and_written_back_as_it_came(tmp_path_factory, file):
    tree, values = content(*file)
    folder = tmp_path_factory.mktemp("layout")
    first, second, third = (folder / f"{name}.bvh" for name in ("first", "second", "third"))
    first.write_text(bvh.compose(tree, "0.0333333", values, decimals=6))
    positions, turns = world(tree, values)
    motion = agrees(first, positions, turns, bvh.load(first).source.metres_per_unit)
    motion.save(second)
    again = agrees(second, positions, turns, motion.source.metres_per_unit)
    assert again.source.hierarchy.channels == tree.channels
    assert again.source.frame_time == "0.0333333"
    again.save(third)
    motion.save(first)
    assert first.read_bytes() == second.read_bytes()
    assert np.abs(bvh.read(third).values - bvh.read(second).values).max() < 1e-4


QUIRKS = {
    "tabs": lambda t: t.replace("  ", "\t"),
    "CRLF": lambda t: t.replace("\n", "\r\n"),
    "mark": lambda t: "\ufeff" + t,
    "scientific": lambda t: t.replace("1 90 3", "1e0 9.0E+1 0.3e1"),
    "spaced colon": lambda t: t.replace("Frames:", "Frames :").replace("Frame Time:", "Frame  Time :"),
    "no colon": lambda t: t.replace("Frames:", "Frames").replace("Frame Time:", "FrameTime"),
    "lower case": lambda t: t.lower().replace("leftupperleg", "leftUpperLeg").replace("leftfoot", "leftFoot"),
    "braces on the line": lambda t: t.replace("\n{", " {").replace("\n  {", "{").replace("}\n  }\n}", "}}}"),
    "blank lines": lambda t: t.replace("\n", "\n\n  \n"),
    "no end": lambda t: t.replace("End Site", "").replace("      {\n        OFFSET 0 0 10\n      }\n", ""),
    "wrapped rows": lambda t: t.replace(" 10 20 30 ", "\n10 20 30\n"),
}


@pytest.mark.parametrize("quirk", QUIRKS)
def test_quirk_reads_as_the_plain_file(quirk, tmp_path):
    (tmp_path / "plain.bvh").write_text(PLAIN)
    (tmp_path / "quirk.bvh").write_bytes(QUIRKS[quirk](PLAIN).encode())
    assert QUIRKS[quirk](PLAIN) != PLAIN
    plain, odd = bvh.load(tmp_path / "plain.bvh"), bvh.load(tmp_path / "quirk.bvh")
    assert odd.skeleton.names == plain.skeleton.names == ("hips", "leftUpperLeg", "leftFoot")
    assert torch.equal(odd.joint_positions(), plain.joint_positions())
    assert torch.equal(odd.local_quat_xyzw, plain.local_quat_xyzw)
    assert odd.fps == plain.fps == 30


def test_a_name_in_an_old_encoding_goes_back_as_the_same_bytes(tmp_path):
    raw = PLAIN.replace("leftFoot", "Fuß").encode("latin-1")
    (tmp_path / "in.bvh").write_bytes(raw)
    bvh.load(tmp_path / "in.bvh").save(tmp_path / "out.bvh")
    assert "Fuß".encode("latin-1") in (tmp_path / "out.bvh").read_bytes()


@pytest.mark.parametrize(("unit", "named"), [(unit, k % 2 == 0) for k, unit in enumerate(UNITS.values())])
def test_unit_is_found_by_the_size_of_the_body_and_undone(unit, named, tmp_path):
    motion = standing()
    bones = motion.skeleton.offsets.numpy() / unit
    names = tuple(motion.skeleton.names if named else (f"bone{j}" for j in range(motion.num_joints)))
    motion = replace(motion, skeleton=replace(motion.skeleton, names=names, end_offsets={}))
    motion.save(tmp_path / "cm.bvh")
    text = bvh.read(tmp_path / "cm.bvh")
    offsets = tuple(tuple(float(x) * 0.01 / unit for x in offset) for offset in text.hierarchy.offsets)
    tree = replace(text.hierarchy, offsets=offsets)
    values = text.values.copy()
    values[:, :3] *= 0.01 / unit
    (tmp_path / "unit.bvh").write_text(bvh.compose(tree, "0.0333333", values, decimals=8))
    read = bvh.load(tmp_path / "unit.bvh")
    assert read.source.metres_per_unit == unit
    torch.testing.assert_close(read.root_position, motion.root_position, atol=1e-6, rtol=0)
    read.save(tmp_path / "back.bvh")
    back = np.array(bvh.read(tmp_path / "back.bvh").hierarchy.offsets)
    order = [names.index(name) for name in tree.names]
    assert np.abs(back[1:] - bones[order][1:]).max() < 1e-5 / unit


@pytest.mark.parametrize("size", [0.14, 0.5, 1.3, 85.0])
def test_a_body_of_any_size_is_read_back_at_its_size(size, tmp_path):
    motion = standing()
    bones, root = motion.skeleton.offsets * size, motion.root_position * size
    motion = replace(motion, skeleton=replace(motion.skeleton, offsets=bones, end_offsets={}), root_position=root)
    motion.save(tmp_path / "own.bvh")
    read = bvh.load(tmp_path / "own.bvh")
    order = [motion.skeleton.index(name) for name in read.skeleton.names]
    torch.testing.assert_close(read.skeleton.offsets[1:], bones[order][1:], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(read.root_position, root, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("leg", [8.0, 16.0, 25.0, 40.0, 62.0, 100.0])
def test_a_unit_is_doubted_where_a_second_one_is_about_as_likely(leg):
    found = guess_unit(("hips", "foot"), (-1, 0), np.array([[0, 0, 0], [0, -leg, 0]]), end_offsets={})
    assert ("a guess" in found.unit_doubt) == (leg in (25.0, 62.0))


def standing(frames=20, seed=0) -> Motion:
    """Smooth random movement of the canonical skeleton."""
    generator = torch.Generator().manual_seed(seed)
    start, stop = torch.randn(2, 21, 3, generator=generator, dtype=torch.float64)
    weight = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None, None]
    quat = rotations.from_rotation_vector(start + weight * (stop - start))
    root = torch.cat([weight[:, :, 0], weight[:, :, 0] * 0 + 0.95, weight[:, :, 0] * 2], dim=1)
    return Motion(CANONICAL, Fraction(30), root, quat)


def test_a_motion_without_source_is_written_in_the_plain_layout(tmp_path):
    motion = standing()
    motion.save(tmp_path / "out.bvh")
    tree = bvh.read(tmp_path / "out.bvh").hierarchy
    assert tree.offsets[0] == (0, 0, 0)
    assert tree.channels[0] == ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    assert set(tree.channels[1:]) == {("Zrotation", "Xrotation", "Yrotation")}
    assert "Frame Time: 0.033333333\n" in (tmp_path / "out.bvh").read_text()
    read = bvh.load(tmp_path / "out.bvh")
    order = [read.skeleton.index(name) for name in CANONICAL.names]
    assert set(read.skeleton.names) == set(CANONICAL.names)
    assert read.skeleton.names[4:7] == ("head", "leftShoulder", "leftUpperArm")
    torch.testing.assert_close(read.joint_positions()[:, order], motion.joint_positions(), atol=1e-7, rtol=0)
    for name, offset in CANONICAL.end_offsets.items():
        assert read.skeleton.end_offsets[name] == pytest.approx(offset, abs=1e-8)


def test_still_six_channel_joints_are_bones_and_travelling_ones_are_not(tmp_path):
    text = PLAIN.replace("CHANNELS 3 Zr", "CHANNELS 6 Xposition Yposition Zposition Zr")
    head = text.split("Frames:")[0]
    rows = "5 0 0 0 0 0 10 90 0 1 2 3 0 -79 1 4 5 6\n5 0 0 0 0 0 11 90 0 1 2 3 0 -79 1 4 5 6\n"
    (tmp_path / "in.bvh").write_text(f"{head}Frames: 2\nFrame Time: 0.01\n{rows}")
    motion = bvh.load(tmp_path / "in.bvh")
    assert list(motion.moving_offsets) == [1]
    assert motion.moving_offsets[1].tolist() == [[0.10, 0.9, 0], [0.11, 0.9, 0]]
    assert motion.skeleton.offsets[2].tolist() == [0, -0.79, 0.01]
    assert motion.root_position.tolist() == [[0.05, 0, 0], [0.05, 0, 0]]
    motion.save(tmp_path / "out.bvh")
    before, after = (bvh.read(tmp_path / f"{name}.bvh") for name in ("in", "out"))
    assert np.abs(before.values - after.values).max() < 1e-5
    assert before.hierarchy == after.hierarchy


def test_channels_are_added_where_the_source_cannot_hold_the_motion(tmp_path):
    text = PLAIN.replace("CHANNELS 6 Xposition Yposition Zposition Zr", "CHANNELS 3 Zr").replace(
        "CHANNELS 3 Zrotation Xrotation Yrotation\n      End", "CHANNELS 1 Xrotation\n      End"
    )
    head = text.split("Frames:")[0]
    rows = "10 20 30 1 2 3 7\n" * 20
    (tmp_path / "in.bvh").write_text(f"{head}Frames: 20\nFrame Time: 0.0333333\n{rows}")
    source = bvh.load(tmp_path / "in.bvh")
    moved = standing()
    wanted = replace(source, root_position=moved.root_position, local_quat_xyzw=moved.local_quat_xyzw[:, :3])
    wanted.save(tmp_path / "out.bvh")
    read = bvh.load(tmp_path / "out.bvh")
    assert [len(channels) for channels in read.source.hierarchy.channels] == [6, 3, 3]
    torch.testing.assert_close(read.joint_positions(), wanted.joint_positions(), atol=1e-7, rtol=0)


@pytest.mark.parametrize("name", ["", " hips", "a{b", "a\nb"])
def test_names_that_bvh_cannot_hold_are_refused(name, tmp_path):
    skeleton = replace(CANONICAL, names=(name, *CANONICAL.names[1:]))
    with pytest.raises(RequestError, match="joint name"):
        replace(standing(), skeleton=skeleton).save(tmp_path / "out.bvh")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fps", [Fraction(1, 1000), Fraction(10**7)])
def test_a_frame_rate_out_of_range_is_refused(fps, tmp_path):
    with pytest.raises(RequestError, match="frames per second"):
        replace(standing(), fps=fps).save(tmp_path / "out.bvh")


def test_two_joints_of_one_name_are_read_the_second_by_a_name_of_its_own(tmp_path, capsys):
    """As other tools do; names in mapctl are unique. A name that the file has already is not taken."""
    path = tmp_path / "twice.bvh"
    path.write_text(PLAIN.replace("JOINT leftFoot", "JOINT hips"))
    motion = formats.load(path)
    assert motion.skeleton.names == ("hips", "leftUpperLeg", "hips_2")
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "twice.bvh: names must be unique, so it reads the joint 'hips' of line 10 as 'hips_2'" in told
    plain = tmp_path / "plain.bvh"
    plain.write_text(PLAIN)
    assert torch.equal(motion.joint_positions(), formats.load(plain).joint_positions())
    formats.save(motion, tmp_path / "again.bvh")
    capsys.readouterr()
    again = formats.load(tmp_path / "again.bvh")
    assert again.skeleton.names == motion.skeleton.names
    torch.testing.assert_close(again.joint_positions(), motion.joint_positions())
    assert capsys.readouterr().err == ""
