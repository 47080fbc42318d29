"""NaN in motion files: what is lost by it, what the motion is there, and what is refused."""

import pytest
import torch
from acclaim import pair
from captures import on_rig
from lossy_files import archive_without, with_all_channels, without

import mapctl
from mapctl import formats
from mapctl.errors import FileFormatError
from mapctl.recording.masks import ROOT, Mask, masks_from_missing

RIGS = ("canonical", "daz")
HAND = {"canonical": "leftHand", "bandai": "Hand_L", "daz": "lHand"}
HIPS = {"canonical": "hips", "bandai": "Hips", "daz": "hip"}


@pytest.fixture(params=RIGS)
def clip(request, tmp_path):
    """A rig's name, its motion as it is read, and its file."""
    on_rig(request.param, 12).save(tmp_path / "whole.bvh")
    return request.param, mapctl.load(tmp_path / "whole.bvh"), tmp_path / "whole.bvh"


def assert_known_where(motion, whole, frames):
    """All of these frames are as in the whole motion; all others are finite rotations and places."""
    one, other = motion.local_quat_xyzw, whole.local_quat_xyzw
    apart = torch.minimum((one - other).norm(dim=-1), (one + other).norm(dim=-1))
    assert apart[frames].max() < 1e-12
    assert (motion.joint_positions() - whole.joint_positions())[frames].abs().max() < 1e-12
    assert (one.norm(dim=-1) - 1).abs().max() < 1e-6
    assert motion.joint_positions().isfinite().all()


@pytest.mark.parametrize("word", ["NaN", "-nan(ind)", "1.#QNAN"])
def test_every_form_of_nan_is_lost_and_nothing_else_is(clip, tmp_path, word):
    rig, whole, file = clip
    lossy = without(file, tmp_path / "lossy.bvh", [(HAND[rig], 4, 7), (f"{HIPS[rig]} Y", 8, 9)], word=word)
    motion, missing = formats.load_with_missing(lossy)
    assert set(masks_from_missing(motion, missing)) == {Mask(HAND[rig], 4, 7), Mask(HIPS[rig], 8, 9), Mask(ROOT, 8, 9)}
    assert_known_where(motion, whole, [*range(4), 7, 9, 10, 11])


@pytest.mark.parametrize("gap", [(0, 3), (5, 6), (9, 12)])
def test_whole_frames_are_lost_whole_also_joints_without_channels(clip, tmp_path, gap):
    _, whole, file = clip
    motion, missing = formats.load_with_missing(without(file, tmp_path / "lossy.bvh", [("", *gap)]))
    assert missing.rotations[gap[0] : gap[1]].all()
    assert set(masks_from_missing(motion, missing)) == {Mask(name, *gap) for name in (*motion.skeleton.names, ROOT)}
    assert_known_where(motion, whole, [frame for frame in range(12) if not gap[0] <= frame < gap[1]])
    assert motion.skeleton.matches(whole.skeleton)


def test_the_place_of_a_still_joint_is_known_by_any_frame_and_by_its_offset(tmp_path):
    file = with_all_channels(on_rig("daz", 12), tmp_path / "in.bvh")
    whole = mapctl.load(file)
    for lost in (("lHand Xposition", 3, 6), ("lHand Xposition", 0, 12)):
        motion, missing = formats.load_with_missing(without(file, tmp_path / "lossy.bvh", [lost]))
        assert masks_from_missing(motion, missing) == ()
        assert_known_where(motion, whole, range(12))


def test_a_joint_that_travels_besides_is_lost_with_its_place_and_goes_straight(tmp_path):
    motion = on_rig("daz", 12)
    hand = motion.skeleton.index("lHand")
    track = motion.skeleton.offsets[hand] + 0.01 * torch.linspace(0, 1, 12).double()[:, None] ** 2
    motion.moving_offsets[hand] = track
    file = with_all_channels(motion, tmp_path / "in.bvh")
    lossy = without(file, tmp_path / "lossy.bvh", [("lHand Zposition", 5, 7)])
    read, missing = formats.load_with_missing(lossy)
    assert masks_from_missing(read, missing) == (Mask("lHand", 5, 7),)
    (number,) = read.moving_offsets
    steps = torch.diff(read.moving_offsets[number][4:8, 2])
    assert (steps - steps[0]).abs().max() < 1e-9


@pytest.mark.parametrize("key", ["local_quat_xyzw", "root_position_world", "moving_offsets"])
def test_nan_in_an_archive(tmp_path, key):
    motion = on_rig("bandai", 12)
    motion.save(tmp_path / "in.npz")
    hips = motion.skeleton.names.index("Hips")
    position = {
        "local_quat_xyzw": (slice(3, 5), hips, 0),
        "root_position_world": (slice(3, 5), 2),
        "moving_offsets": (0, slice(3, 5), 1),
    }[key]
    lossy = archive_without(tmp_path / "in.npz", tmp_path / "lossy.npz", **{key: position})
    with pytest.raises(FileFormatError, match=rf"{key} at \[.*\]: .*; `mapctl infill` fills in what is lost"):
        mapctl.load(lossy)
    read, missing = formats.load_with_missing(lossy)
    # The root stands still: where it is in other frames, it is in these.
    wanted = {"local_quat_xyzw": (Mask("Hips", 3, 5),), "moving_offsets": (Mask(ROOT, 3, 5),)}.get(key, ())
    assert masks_from_missing(read, missing) == wanted
    assert_known_where(read, motion, [*range(3), *range(5, 12)])


def test_nan_in_a_take_of_acclaim(tmp_path):
    result = pair(6)
    (tmp_path / "a.asf").write_text(result.asf())
    text = result.amc()
    (tmp_path / "a.amc").write_text(text)
    whole = mapctl.load(tmp_path / "a.amc")
    bone = next(line.split()[0] for line in text.splitlines() if line.split()[0].endswith("humerus"))
    rows, frame = text.splitlines(), 0
    for number, row in enumerate(rows):
        frame = int(row) if row.isdecimal() else frame
        words = row.split()
        if (words[0], frame) in ((bone, 2), (bone, 3), ("root", 5)):
            rows[number] = " ".join([words[0], "nan", *words[2:]])
    (tmp_path / "a.amc").write_text("\n".join(rows) + "\n")
    with pytest.raises(FileFormatError, match=r"expected a finite number.*'nan'; `mapctl infill` fills"):
        mapctl.load(tmp_path / "a.amc")
    motion, missing = formats.load_with_missing(tmp_path / "a.amc")
    first = int(next(row for row in rows if row.isdecimal()))
    lost = {(mask.joint, mask.start + first, mask.stop + first) for mask in masks_from_missing(motion, missing)}
    assert (bone, 2, 4) in lost
    assert len(lost) == 2
    known = [frame for frame in range(6) if frame + first not in (2, 3, 5)]
    assert_known_where(motion, whole, known)


@pytest.mark.parametrize(
    ("lost", "word", "said"),
    [
        ([("", 0, 12)], "nan", "every value is nan: nothing is known of the motion"),
        ([("Hand_L", 3, 4)], "inf", "frame 3, column .*Hand_L Zrotation.*expected a finite number.*got 'inf'$"),
        ([("Hand_L", 3, 4)], "nothing", "got 'nothing'$"),
        ([("Hand_L", 3, 4)], "nan1", "got 'nan1'$"),
        ([("Hand_L", 3, 4)], "1e9", "got '1e9'$"),
    ],
)
def test_what_is_no_number_and_no_nan_is_refused(tmp_path, lost, word, said):
    on_rig("bandai", 12).save(tmp_path / "in.bvh")
    lossy = without(tmp_path / "in.bvh", tmp_path / "lossy.bvh", lost, word=word)
    with pytest.raises(FileFormatError, match=said):
        formats.load_with_missing(lossy)
