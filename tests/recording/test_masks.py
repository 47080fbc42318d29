"""Masks: what of a recording its user says not to believe."""

import pytest
import torch
from captures import on_rig

from mapctl.errors import FileFormatError, RequestError
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks, load_masks


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


def test_columns_in_any_order_more_of_them_and_a_byte_order_mark_are_fine(read):
    text = "stop,note,joint,start\r\n12,lost,lHand,0\r\n"
    assert read(text, "utf-8-sig") == (Mask("lHand", 0, 12),)


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
    joints, root = expand_valid_masks(motion, [Mask("lHand", 3, 7), Mask(ROOT, 10, 12), Mask(ALL, 20, 21)])
    wanted = torch.zeros(40, motion.num_joints, dtype=torch.bool)
    wanted[3:7, motion.skeleton.index("lHand")] = True
    wanted[20] = True
    assert torch.equal(joints, wanted)
    assert root.nonzero()[:, 0].tolist() == [10, 11, 20]


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
