"""What a file that was read must be, kind by kind, told by patterns that share nothing with the readers."""

import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from forged_characters import count_nodes

from mapctl import formats
from mapctl.curves.csv_file import read_csv
from mapctl.curves.svg_file import read_svg
from mapctl.errors import FileFormatError
from mapctl.formats.bvh import text as bvh_text
from mapctl.formats.bvh.layout import BvhLayout
from mapctl.intent.steering_csv import read_commands
from mapctl.motion import Motion
from mapctl.recording.masks import load_masks


class Broken(Exception):
    """A reader that did not keep its word."""


def check_motion(motion: Motion) -> None:
    """Finite, of unit quaternions, and of one number of frames."""
    frames = motion.num_frames
    require(bool(motion.joint_positions().isfinite().all()), "a joint is not at a finite place")
    lengths = motion.local_quat_xyzw.norm(dim=-1)
    require(bool(((lengths - 1).abs() < 2e-3).all()), "a rotation is no unit quaternion")
    require(all(track.shape == (frames, 3) for track in motion.moving_offsets.values()), "a track of another length")
    require(0 < motion.fps < 1e6, f"{motion.fps} frames a second")


def check_bvh(path: Path) -> None:
    """The counts are those of the text, told by patterns that share nothing with the reader."""
    motion = formats.load(path)
    check_motion(motion)
    text = plain(path)
    begin = [match.end() for match in re.finditer(r"(?i)(?<![^\s}])motion(?!\S)", text)][-1]  # a joint may be named so
    head, rest = text[:begin], text[begin:]
    found = re.search(r"(?i)frames\s*:?\s*(\S+)\s+frame\s*time\s*:?\s*(\S+)", rest)
    require(found is not None, "read without Frames")
    assert found is not None
    said = sum(int(count) for count in re.findall(r"(?i)(?<![^\s{}])channels\s+(\d+)", head))
    values = rest[found.end() :].split()
    require(int(found[1]) == motion.num_frames, f"{found[1]} frames in the text, {motion.num_frames} read")
    require(len(values) == motion.num_frames * said, f"{len(values)} values for {motion.num_frames} of {said} channels")
    kept = bvh_text.read(path).values.reshape(-1).tolist()
    require(kept == [float(value) for value in values], "other values were read")
    assert isinstance(motion.source, BvhLayout)
    require(len(motion.source.hierarchy.labels()) == said, "another number of channels was read")
    joints = len(re.findall(r"(?i)(?<![^\s{}])(?:root|joint)(?=\s)", head))
    require(joints >= motion.num_joints, f"{joints} joints in the text, {motion.num_joints} read")
    again = path.with_name("again.bvh")
    motion.save(again)
    require(formats.load(again).num_frames == motion.num_frames, "written, it is another motion")


def check_acclaim(path: Path) -> None:
    """As many frames as lines with a number alone, as many joints as bones and the root."""
    motion = formats.load(path)
    check_motion(motion)
    lines = [
        line.partition("#")[0].replace(",", " ").replace("(", " ").replace(")", " ").split()
        for line in plain(path).split("\n")
    ]
    said = sum(len(words) == 1 and words[0].isdigit() for words in lines)
    require(said == motion.num_frames, f"{said} frames in the text, {motion.num_frames} read")
    bones = plain(path.with_suffix(".asf")).partition(":bonedata")[2].partition(":hierarchy")[0]
    said = len(re.findall(r"(?im)^[\s,()]*begin(?!\S)", bones)) + 1
    require(said == motion.num_joints, f"{said} joints in the text, {motion.num_joints} read")


def check_npz(path: Path) -> None:
    """Every array of the archive is in the motion."""
    motion = formats.load(path)
    check_motion(motion)
    with np.load(path, allow_pickle=False) as arrays:
        require(np.array_equal(arrays["root_position_world"], motion.root_position.numpy()), "another way")
        require(np.array_equal(arrays["local_quat_xyzw"], motion.local_quat_xyzw.numpy()), "other rotations")
        require(arrays["names"].tolist() == list(motion.skeleton.names), "other names")
        require(len(arrays["end_names"]) == len(motion.skeleton.end_offsets), "fewer End Sites")
        require(len(arrays["moving_joints"]) == len(motion.moving_offsets), "fewer travelling joints")


def check_commands(path: Path) -> None:
    """A command a line; times rise."""
    track = read_commands(path)
    require(len(track.times) == len(track.commands) == filled(path) - 1, f"{len(track.times)} commands read")
    require(bool(np.isfinite(track.times).all() and (np.diff(track.times) > 0).all()), "times do not rise")
    for command in track.commands:
        numbers = [value for value in vars(command).values() if isinstance(value, float)]
        require(bool(np.isfinite(numbers).all()), "a command is not finite")


def check_curve(path: Path) -> None:
    """A point a line, but for comments and a header."""
    points = read_csv(path)
    require(points.ndim == 2 and bool(np.isfinite(points).all()), "points are not finite")
    said = sum(bool(line.partition("#")[0].strip()) for line in text_of(path).splitlines())
    require(len(points) in (said, said - 1), f"{said} lines, {len(points)} points")


def check_svg(path: Path) -> None:
    """Finite points."""
    points = read_svg(path)
    require(points.ndim == 2 and len(points) > 1 and bool(np.isfinite(points).all()), "points are not finite")


def check_masks(path: Path) -> None:
    """A mask a line."""
    masks = load_masks(path)
    require(all(0 <= mask.start < mask.stop for mask in masks), "a mask of no frames")
    require(len(masks) == filled(path) - 1, f"{len(masks)} masks of {filled(path) - 1} lines")


def check_character(path: Path) -> None:
    """As a clip, at rest and as triangles; written again, it is the same motion."""
    motion, mesh = formats.load(path), formats.load_mesh(path)
    check_motion(motion)
    require(formats.load_rest(path).num_joints == motion.num_joints, "other joints at rest")
    require(motion.num_joints <= count_nodes(path), "more joints than nodes")
    require(bool(np.isfinite(mesh.vertices).all() and np.isfinite(mesh.rgba).all()), "a vertex is not finite")
    require(len(mesh.faces) == 0 or mesh.faces.max() < len(mesh.vertices), "a face without vertices")
    require(bool(mesh.joints.max() < motion.num_joints), "a vertex without a joint")
    again = path.with_name("again.glb")
    motion.save(again)
    require(formats.load(again).num_frames == motion.num_frames, "written, it is another motion")


def check_other_character(path: Path) -> None:
    """As a clip, and as triangles where there are any; written again where that can be, it is the same motion."""
    motion = formats.load(path)
    check_motion(motion)
    require(motion.num_joints <= 64, f"{motion.num_joints} joints")
    try:
        mesh = formats.load_mesh(path)
    except FileFormatError:
        return
    require(bool(np.isfinite(mesh.vertices).all() and np.isfinite(mesh.rgba).all()), "a vertex is not finite")
    require(len(mesh.faces) == 0 or mesh.faces.max() < len(mesh.vertices), "a face without vertices")
    require(bool(mesh.joints.max() < motion.num_joints), "a vertex without a joint")
    if path.suffix != ".fbx":
        again = path.with_name(f"again{path.suffix}")
        motion.save(again)
        other = formats.load(again)
        require(other.num_frames == motion.num_frames, "written, it is another motion")
        far = float((other.joint_positions() - motion.joint_positions()).abs().max())
        size = float(motion.joint_positions().abs().max())
        require(far < 1e-4 * max(size, 1.0), f"written, joints are {far:g} m elsewhere")


ISOLATED = ("usda", "usdc", "fbx")
"""Kinds that are read in a process of its own."""
READERS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "bvh": ("x.bvh", check_bvh),
    "amc": ("x.amc", check_acclaim),
    "asf": ("x.amc", check_acclaim),
    "npz": ("x.npz", check_npz),
    "glb": ("x.glb", check_character),
    **{kind: (f"x.{kind}", check_other_character) for kind in ISOLATED},
    "commands": ("x.csv", check_commands),
    "curve": ("x.csv", check_curve),
    "svg": ("x.svg", check_svg),
    "masks": ("x.csv", check_masks),
}
"""By kind of file, its name on disk and what reads and checks it."""


def require(holds: bool, otherwise: str) -> None:
    """Broken unless it holds."""
    if not holds:
        raise Broken(otherwise)


def text_of(path: Path) -> str:
    """The file as text, whatever it is."""
    raw = path.read_bytes()
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def plain(path: Path) -> str:
    """The same with plain line feeds."""
    return text_of(path).replace("\r\n", "\n").replace("\r", "\n")


def filled(path: Path) -> int:
    """Lines of a table that hold a value; none of the specimens quotes a line end."""
    return sum(
        bool(line.replace(",", "").replace('"', "").strip()) for line in io.StringIO(text_of(path), newline=None)
    )
