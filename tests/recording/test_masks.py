"""Masks: what of a recording its user marks as unreliable; captures, in which that is filled in."""

import pytest
import torch
from captures import on_rig, shaken
from helpers import walk

from mapctl.errors import FileFormatError, RequestError
from mapctl.recording import Capture
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks, load_masks
from mapctl.skeleton import CANONICAL


@pytest.fixture
def read(tmp_path):
    def write(text, encoding="utf-8"):
        path = tmp_path / "mask.csv"
        path.write_bytes(text.encode(encoding))
        return load_masks(path)

    return write


def test_a_csv_is_read(read):
    text = "joint,start,stop\nlHand,0,12\n*,3, 5\n root position ,7,8\n"
    assert read(text) == (Mask("lHand", 0, 12), Mask(ALL, 3, 5), Mask(ROOT, 7, 8))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("joint,start\nlHand,0\n", "needs the columns joint, start, stop, each once; found 'joint,start'"),
        ("joint,start,stop\nlHand,0,12\nrHand,x,4\n", "line 3: expected a joint and two whole frames"),
        ("joint,start,stop\nlHand,1.5,4\n", "line 2: expected a joint and two whole frames"),
        ("joint,start,stop\nlHand,1\n", "line 2: found 2 values where 3 belong"),
        ("joint,start,stop\nlHand,4,4\n", "line 2: needs 0 <= start < stop, got 4 and 4"),
        ("joint,start,stop\nlHand,-1,4\n", "line 2: needs 0 <= start < stop, got -1 and 4"),
    ],
)
def test_errors_name_the_line(read, text, message):
    with pytest.raises(FileFormatError, match=message.replace(".", r"\.")):
        read(text)


@pytest.fixture(scope="module")
def motion():
    return on_rig("daz", 40)


def test_a_joint_a_place_and_everything(motion):
    missing = expand_valid_masks(motion, [Mask("lHand", 3, 7), Mask(ROOT, 10, 12), Mask(ALL, 20, 21)])
    wanted = torch.zeros(40, motion.num_joints, dtype=torch.bool)
    wanted[3:7, motion.skeleton.index("lHand")] = True
    wanted[20] = True
    assert torch.equal(missing.joints, wanted)
    assert missing.root.nonzero()[:, 0].tolist() == [10, 11, 20]


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ([Mask("lhnad", 0, 3)], "no joint 'lhnad' to mask; the nearest is lHand"),
        ([Mask("rTigh", 0, 3)], "nearest is rThigh"),
        ([Mask("lHand", 30, 41)], "the mask of lHand ends at 41, the recording at 40"),
        ([Mask("lHand", 0, 20), Mask("lHand", 20, 40)], "the masks leave nothing of lHand"),
        ([Mask(ROOT, 0, 40)], "the masks leave nothing of root position"),
        ([Mask(ALL, 0, 40)], "the masks leave nothing of"),
    ],
)
def test_masks_that_do_not_fit_are_refused(motion, masks, message):
    with pytest.raises(RequestError, match=message):
        expand_valid_masks(motion, masks)


def capture_of(motion, seen=None, seen_root=None):
    everything = torch.ones(motion.num_frames, motion.num_joints, dtype=torch.bool)
    return Capture.of_motion(
        motion,
        seen=everything if seen is None else seen,
        seen_root=everything[:, 0] if seen_root is None else seen_root,
        sigma=torch.zeros(motion.num_joints),
        sigma_root=0.0,
    )


@pytest.mark.parametrize("lost", [(20, 30), (0, 4), (55, 60)])
def test_what_unseen_frames_show_does_not_matter_to_heading_and_tilt(lost):
    motion = walk(60, turn_rate=2.0)
    seen = torch.ones(60, CANONICAL.num_joints, dtype=torch.bool)
    seen[lost[0] : lost[1], 0] = False
    whole, shown = capture_of(motion, seen), []
    for seed in (1, 2):
        wild = shaken(motion.local_quat_xyzw, 3.0, seed=seed)
        quats = torch.where(seen[..., None], motion.local_quat_xyzw, wild)
        shown.append(capture_of(type(motion)(motion.skeleton, motion.fps, motion.root_position, quats), seen))
    for capture in shown:
        assert torch.allclose(capture.heading, whole.heading, atol=1e-5)
        assert torch.allclose(capture.tilt, whole.tilt, atol=1e-5)
    truth = capture_of(motion).heading
    assert (whole.heading - truth).abs().max() < 0.5  # filled in, no turn lost
