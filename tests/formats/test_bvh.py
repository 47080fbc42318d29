"""BVH reading and writing against an independent reading of the format: layouts, rates, Euler orders, broken files."""

import tracemalloc
from dataclasses import replace
from fractions import Fraction
from itertools import product

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from captures import on_rig, swaying
from hypothesis import given, settings
from lossy_files import GOOD, with_all_channels

import mapctl
from mapctl import formats, rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import bvh
from mapctl.formats.units import UNITS, frame_rate, guess_unit
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL


def turn(axis: int, degrees: float) -> np.ndarray:
    """Rotation matrix about one axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(np.radians(degrees))
    matrix[j, i] = np.sin(np.radians(degrees))
    matrix[i, j] = -matrix[j, i]
    return matrix


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
    motion = formats.load(path)
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
    motion = agrees(first, positions, turns, formats.load(first).source.metres_per_unit)
    motion.save(second)
    again = agrees(second, positions, turns, motion.source.metres_per_unit)
    assert again.source.hierarchy.channels == tree.channels
    assert again.source.frame_time == "0.0333333"
    again.save(third)
    motion.save(first)
    assert first.read_bytes() == second.read_bytes()
    assert (
        np.abs(bvh.read(third, lossy=False)[0].source.values - bvh.read(second, lossy=False)[0].source.values).max()
        < 1e-4
    )


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
    plain, odd = formats.load(tmp_path / "plain.bvh"), formats.load(tmp_path / "quirk.bvh")
    assert odd.skeleton.names == plain.skeleton.names == ("hips", "leftUpperLeg", "leftFoot")
    assert torch.equal(odd.joint_positions(), plain.joint_positions())
    assert torch.equal(odd.local_quat_xyzw, plain.local_quat_xyzw)
    assert odd.fps == plain.fps == 30


def test_a_name_in_an_old_encoding_goes_back_as_the_same_bytes(tmp_path):
    raw = PLAIN.replace("leftFoot", "Fuß").encode("latin-1")
    (tmp_path / "in.bvh").write_bytes(raw)
    formats.load(tmp_path / "in.bvh").save(tmp_path / "out.bvh")
    assert "Fuß".encode("latin-1") in (tmp_path / "out.bvh").read_bytes()


@pytest.mark.parametrize(("unit", "named"), [(unit, k % 2 == 0) for k, unit in enumerate(UNITS.values())])
def test_unit_is_found_by_the_size_of_the_body_and_undone(unit, named, tmp_path):
    motion = standing()
    bones = motion.skeleton.offsets.numpy() / unit
    names = tuple(motion.skeleton.names if named else (f"bone{j}" for j in range(motion.num_joints)))
    motion = replace(motion, skeleton=replace(motion.skeleton, names=names, end_offsets={}))
    motion.save(tmp_path / "cm.bvh")
    text = bvh.read(tmp_path / "cm.bvh", lossy=False)[0].source
    offsets = tuple(tuple(float(x) * 0.01 / unit for x in offset) for offset in text.hierarchy.offsets)
    tree = replace(text.hierarchy, offsets=offsets)
    values = text.values.copy()
    values[:, :3] *= 0.01 / unit
    (tmp_path / "unit.bvh").write_text(bvh.compose(tree, "0.0333333", values, decimals=8))
    read = formats.load(tmp_path / "unit.bvh")
    assert read.source.metres_per_unit == unit
    torch.testing.assert_close(read.root_position, motion.root_position, atol=1e-6, rtol=0)
    read.save(tmp_path / "back.bvh")
    back = np.array(bvh.read(tmp_path / "back.bvh", lossy=False)[0].source.hierarchy.offsets)
    order = [names.index(name) for name in tree.names]
    assert np.abs(back[1:] - bones[order][1:]).max() < 1e-5 / unit


@pytest.mark.parametrize("size", [0.14, 0.5, 1.3, 85.0])
def test_a_body_of_any_size_is_read_back_at_its_size(size, tmp_path):
    motion = standing()
    bones, root = motion.skeleton.offsets * size, motion.root_position * size
    motion = replace(motion, skeleton=replace(motion.skeleton, offsets=bones, end_offsets={}), root_position=root)
    motion.save(tmp_path / "own.bvh")
    read = formats.load(tmp_path / "own.bvh")
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
    tree = bvh.read(tmp_path / "out.bvh", lossy=False)[0].source.hierarchy
    assert tree.offsets[0] == (0, 0, 0)
    assert tree.channels[0] == ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    assert set(tree.channels[1:]) == {("Zrotation", "Xrotation", "Yrotation")}
    assert "Frame Time: 0.033333333\n" in (tmp_path / "out.bvh").read_text()
    read = formats.load(tmp_path / "out.bvh")
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
    motion = formats.load(tmp_path / "in.bvh")
    assert list(motion.moving_offsets) == [1]
    assert motion.moving_offsets[1].tolist() == [[0.10, 0.9, 0], [0.11, 0.9, 0]]
    assert motion.skeleton.offsets[2].tolist() == [0, -0.79, 0.01]
    assert motion.root_position.tolist() == [[0.05, 0, 0], [0.05, 0, 0]]
    motion.save(tmp_path / "out.bvh")
    before, after = (bvh.read(tmp_path / f"{name}.bvh", lossy=False)[0].source for name in ("in", "out"))
    assert np.abs(before.values - after.values).max() < 1e-5
    assert before.hierarchy == after.hierarchy


def test_channels_are_added_where_the_source_cannot_hold_the_motion(tmp_path):
    text = PLAIN.replace("CHANNELS 6 Xposition Yposition Zposition Zr", "CHANNELS 3 Zr").replace(
        "CHANNELS 3 Zrotation Xrotation Yrotation\n      End", "CHANNELS 1 Xrotation\n      End"
    )
    head = text.split("Frames:")[0]
    rows = "10 20 30 1 2 3 7\n" * 20
    (tmp_path / "in.bvh").write_text(f"{head}Frames: 20\nFrame Time: 0.0333333\n{rows}")
    source = formats.load(tmp_path / "in.bvh")
    moved = standing()
    wanted = replace(source, root_position=moved.root_position, local_quat_xyzw=moved.local_quat_xyzw[:, :3])
    wanted.save(tmp_path / "out.bvh")
    read = formats.load(tmp_path / "out.bvh")
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
    given = capsys.readouterr().err
    assert given.count("\n") == 1
    assert "twice.bvh: names must be unique, so it reads the joint 'hips' of line 10 as 'hips_2'" in given
    plain = tmp_path / "plain.bvh"
    plain.write_text(PLAIN)
    assert torch.equal(motion.joint_positions(), formats.load(plain).joint_positions())
    formats.save(motion, tmp_path / "again.bvh")
    capsys.readouterr()
    again = formats.load(tmp_path / "again.bvh")
    assert again.skeleton.names == motion.skeleton.names
    torch.testing.assert_close(again.joint_positions(), motion.joint_positions())
    assert capsys.readouterr().err == ""


def written_angles(quat, order, tmp_path):
    """Angles written in the three channels of a single joint, degrees."""
    tree = bvh.Hierarchy(("only",), (-1,), ((0.0,) * 3,), (tuple(AXES[a] + "rotation" for a in order),), {})
    (tmp_path / "in.bvh").write_text(bvh.compose(tree, "0.01", np.zeros((1, 3)), decimals=6))
    source = formats.load(tmp_path / "in.bvh")
    root = torch.zeros(len(quat), 3, dtype=torch.float64)
    replace(source, root_position=root, local_quat_xyzw=quat[:, None]).save(tmp_path / "out.bvh")
    return bvh.read(tmp_path / "out.bvh", lossy=False)[0].source.values


def euler_quat(degrees, order):
    """Quaternions of angles (frames, 3) by matrices."""
    turns = [turn(order[0], a) @ turn(order[1], b) @ turn(order[2], c) for a, b, c in degrees]
    return rotations.make_sign_continuous(rotations.from_matrix(torch.from_numpy(np.array(turns))))


@pytest.mark.parametrize("order", EULER_ORDERS)
def test_angles_are_written_continuous_through_turns_and_past_the_middle_axis_range(order, tmp_path):
    # The middle angle leaves its principal range on the way, and the outer ones wind up.
    steps = np.linspace(0, 1, 200)[:, None]
    degrees = np.array([10.0, 20.0, -30.0]) + steps * np.array([800.0, 145.0, -500.0])
    assert np.abs(written_angles(euler_quat(degrees, order), order, tmp_path) - degrees).max() < 1e-5


@pytest.mark.parametrize("order", EULER_ORDERS)
def test_gimbal_lock_keeps_the_rotation_and_does_not_jump(order, tmp_path):
    steps = np.linspace(0, 1, 50)
    locked = np.full(50, 0.0 if order[0] == order[2] else 90.0)
    degrees = np.stack([20 + 100 * steps, locked, 40 - 10 * steps], axis=1)
    quat = euler_quat(degrees, order)
    written = written_angles(quat, order, tmp_path)
    assert np.abs(np.diff(written, axis=0)).max() < 3
    assert ((euler_quat(written, order) * quat).sum(-1).abs() > 1 - 1e-12).all()


FRAMES = 40


def restless(file, seed):
    """The file's angles as equal ones: now and then the other Euler solution, or by whole turns, joint by joint."""
    read, draw = bvh.read(file, lossy=False)[0].source, np.random.default_rng(seed)
    values = read.values.copy()
    for _, _, columns in read.hierarchy.rotation_groups():
        for joint in columns:
            first, middle, last = values[:, joint].T
            twin = np.stack([first + 180, 180 - middle, last + 180], axis=1)
            from_frame = np.sort(draw.integers(0, FRAMES, 2))
            frame = np.arange(FRAMES)
            other = (frame >= from_frame[0]) & (frame < from_frame[1])
            turns = 360 * draw.integers(-2, 3, (4, 3))[np.sort(draw.integers(0, 4, FRAMES))]
            values[:, joint] = np.where(other[:, None], twin, values[:, joint]) + turns
    file.write_text(bvh.compose(read.hierarchy, read.frame_time, values, decimals=6))
    return file


@pytest.fixture(params=(1, 2))
def source(request, tmp_path):
    """A file of six channels a joint in drawn Euler orders, whose angles jump between equal ones."""
    rig = ("canonical", "bandai", "daz", "daz")[request.param]
    return restless(with_all_channels(on_rig(rig, FRAMES), tmp_path / "in.bvh", seed=request.param), request.param)


def turned(motion, start, stop, *, seed=0, size=1.0):
    """Every joint turned by something smooth in these frames, that fades in and out."""
    sway = swaying(stop - start, motion.num_joints, seed=seed, highest=2.0)
    fade = torch.sin(torch.linspace(0, torch.pi, stop - start + 2, dtype=torch.float64))[1:-1]
    vectors = size * fade[:, None, None] * rotations.to_rotation_vector(sway)
    quats = motion.local_quat_xyzw.clone()
    quats[start:stop] = rotations.multiply(quats[start:stop], rotations.from_rotation_vector(vectors))
    return replace(motion, local_quat_xyzw=quats)


def test_a_motion_comes_back_in_the_same_numbers(source, tmp_path):
    mapctl.load(source).save(tmp_path / "out.bvh")
    assert (tmp_path / "out.bvh").read_text() == source.read_text()


@pytest.mark.parametrize("gap", [(0, 12), (9, 23)])
def test_frames_that_are_not_changed_have_the_numbers_of_the_file(source, tmp_path, gap):
    start, stop = gap
    motion = turned(mapctl.load(source), start, stop)
    motion.save(tmp_path / "out.bvh")
    before, after = (bvh.read(path, lossy=False)[0].source.values for path in (source, tmp_path / "out.bvh"))
    known = [frame for frame in range(FRAMES) if not start <= frame < stop]
    assert np.array_equal(before[known], after[known])
    again = mapctl.load(tmp_path / "out.bvh")
    assert (again.joint_positions() - motion.joint_positions()).abs().max() < 1e-6


@pytest.mark.parametrize("gap", [(9, 23), (30, FRAMES)])
def test_angles_in_changed_frames_go_on_from_those_before_or_lead_to_those_after(source, tmp_path, gap):
    start, stop = gap
    motion = mapctl.load(source)
    turned(motion, start, stop, size=0.02).save(tmp_path / "out.bvh")
    read = bvh.read(tmp_path / "out.bvh", lossy=False)[0].source
    edges = slice(max(0, start - 1), stop if start else stop + 1)
    for _, _, columns in read.hierarchy.rotation_groups():
        steps = np.abs(np.diff(read.values[edges][:, columns], axis=0))
        assert steps.max() < 120  # by gimbal lock, some; a whole turn or the other solution is 180 or more


def test_what_was_written_into_the_tensors_is_written(source, tmp_path):
    motion = mapctl.load(source)
    motion.root_position[7:9] += 0.5
    motion.local_quat_xyzw[20, 3] = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    motion.save(tmp_path / "out.bvh")
    again = mapctl.load(tmp_path / "out.bvh")
    assert (again.joint_positions() - motion.joint_positions()).abs().max() < 1e-6


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new, 1)


# What is broken: the text, the line of the message (None: the whole file), words it must hold.
BROKEN = {
    "no hierarchy": ("hello\n", 1, "expected 'HIERARCHY', got 'hello'"),
    "cut in the hierarchy": (GOOD[:90], 5, "end of the file"),
    "cut after Frame Time": (GOOD.split("\n1 90")[0], 17, "'Frames: 3' but no whole row"),
    "cut in the only row": (GOOD.split("\n2 91")[0][:-4], 17, "'Frames: 3' but no whole row"),
    "cut in a row before the last": (swap("2 91 4 ", "2 91 ").replace("Frames: 3", "Frames: 4"), 20, "frame 1 has"),
    "nan": (swap("21 31", "nan 31"), 20, r"frame 1, column 5 \(hips Xrotation\): expected a finite number"),
    "inf": (swap("3 4 5\n", "3 -inf 5\n"), 21, r"frame 2, column 8 \(leg Xrotation\)"),
    "word": (swap("22", "x22"), 21, "'x22'"),
    "decimal comma": (swap("22", "22,5"), 21, "'22,5'"),
    "nan in wrapped rows": (swap("12 22", "12\nnan"), 22, r"frame 2, column 5 \(hips Xrotation\)"),
    "value missing": (swap("2 91 ", "2 "), 20, "frame 1 has 8 values, expected 9"),
    "value too many": (swap("2 91 ", "2 2 91 "), 20, "frame 1 has 10 values, expected 9"),
    "text after the rows": (GOOD + "end\n", 22, "'end'"),
    "negative frames": (swap("Frames: 3", "Frames: -3"), 17, "positive number of frames"),
    "zero frame time": (swap("0.0333333", "0"), 18, "frame time between"),
    "endless frame time": (swap("0.0333333", "0.0" + "3" * 10_000), 18, "frame time between"),
    "two roots": (swap("MOTION", "ROOT other\n{\n OFFSET 0 0 0\n}\nMOTION"), 16, "a second ROOT"),
    "joint as root": (swap("ROOT", "JOINT"), 2, "JOINT outside"),
    "brace missing": (swap("  }\n}\n", "  }\n"), 15, "joint 'hips' is still open"),
    "no offset": (swap("    OFFSET 10 0 0\n", ""), 13, "joint 'leg' has no OFFSET"),
    "two ends": (swap("    End Site", "    End Site { OFFSET 0 0 0 }\n End Site"), 11, "a second End Site"),
    "joint in an end": (swap("OFFSET 0 0 10", "OFFSET 0 0 10 JOINT x { }"), 12, "a JOINT within an End Site"),
    "channels in an end": (swap("OFFSET 0 0 10", "CHANNELS 1 Xrotation"), 12, "0 to 0 CHANNELS"),
    "seven channels": (swap("CHANNELS 6", "CHANNELS 7"), 5, "expected 0 to 6 CHANNELS"),
    "unknown channel": (swap("Zrotation", "Wrotation"), 5, "expected a channel as Xposition"),
    "channel twice": (swap("Xposition Yposition", "Xposition Xposition"), 5, "Euler order"),
    "two channel lists": (swap("    End", "    CHANNELS 0\n    End"), 10, "a second CHANNELS"),
    "no channels at all": (
        "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 }\nMOTION\nFrames: 1\nFrame Time: 0.1\n\n",
        4,
        "CHANNELS",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_file_is_refused_with_its_place(case, tmp_path):
    text, line, words = BROKEN[case]
    path = tmp_path / "walk.bvh"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=words) as caught:
        formats.load(path)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"{path}, line {line}: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 250


# What differs from `Frames: 3` and three rows: the text, the number of frames that are read, words of the warning.
UNEVEN = {
    "row too many": (GOOD + "1 2 3 4 5 6 7 8 9\n", 4, "'Frames: 3' but 4 whole rows follow; it reads those"),
    "row too few": (GOOD.split("3 92")[0], 2, "'Frames: 3' but 2 whole rows follow; it reads those"),
    "cut in a row": (GOOD[:-9], 2, "2 whole rows follow, before one that is cut off; it reads those"),
    "cut in the last number": (swap("Frames: 3", "Frames: 9").rstrip(), 2, "before one that is cut off"),
    "header of a recorder that died": (swap("Frames: 3", "Frames: 0"), 3, "'Frames: 0' but 3 whole rows follow; it"),
}


@pytest.mark.parametrize("case", UNEVEN)
def test_whole_rows_are_read_with_one_warning(case, tmp_path, capsys):
    text, frames, words = UNEVEN[case]
    path = tmp_path / "walk.bvh"
    path.write_text(text)
    motion = formats.load(path)
    assert motion.num_frames == frames
    err = capsys.readouterr().err
    assert err.startswith(f"mapctl: {path}: ")
    assert words in err
    assert err.count("\n") == 1
    same = min(frames, 3)
    (tmp_path / "good.bvh").write_text(GOOD)
    assert torch.equal(motion.root_position[:same], formats.load(tmp_path / "good.bvh").root_position[:same])
    lossy, lost = formats.load_with_missing(path)
    assert lossy.num_frames == frames
    assert not lost.rotations.any()


def test_a_cut_row_may_hold_nan(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(swap("2 91 4", "nan 91 4").replace("3 92", "nan 92")[:-9])
    motion, lost = formats.load_with_missing(path)
    assert motion.num_frames == 2
    assert lost.positions[:, 0].tolist() == [False, True]


BYTES = {
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8, "binary"),
    "zero in a row": (GOOD.replace("22", "2\0").encode(), "line 21: is a binary file"),
    "UTF-16": (GOOD.encode("utf-16"), "UTF-16"),
}


@pytest.mark.parametrize("case", BYTES)
def test_what_is_no_text_is_refused(case, tmp_path):
    raw, words = BYTES[case]
    (tmp_path / "walk.bvh").write_bytes(raw)
    with pytest.raises(FileFormatError, match=words) as caught:
        formats.load(tmp_path / "walk.bvh")
    assert str(caught.value).isprintable()


def test_a_declared_count_allocates_nothing(tmp_path):
    (tmp_path / "walk.bvh").write_text(swap("Frames: 3", "Frames: 999999999999"))
    tracemalloc.start()
    try:
        assert formats.load(tmp_path / "walk.bvh").num_frames == 3
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


RATES = {
    "0.0333333": 30,
    "0.0333": 30,
    "3.33333e-2": 30,
    "0.03333333507180214": 30,
    "0.00833333": 120,
    "0.008333": 120,
    "0.016667": 60,
    "0.0416667": 24,
    "0.041708": Fraction(24000, 1001),
    "0.033367": Fraction(30000, 1001),
    "0.04": 25,
    "0.01": 100,
    "0.08": Fraction(25, 2),
    "0.0142857": 70,
    "0.133333": Fraction(15, 2),
    "0.033898305": Fraction(59, 2),
    "0.0345678": Fraction(10**7, 345678),
}


@pytest.mark.parametrize("text", RATES)
def test_frame_time_is_read_as_the_rate_it_was_printed_from(text):
    assert frame_rate(text) == RATES[text]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.integers(1, 999), st.integers(6, 12))
def test_every_whole_rate_survives_its_print(fps, digits):
    assert abs(frame_rate(f"{1 / fps:.{digits}f}") - fps) / fps <= 0.5 * 10.0**-digits * fps
    assert frame_rate(f"{1 / fps:.9f}") == fps
