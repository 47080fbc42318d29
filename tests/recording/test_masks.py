"""Masks: what of a recording its user says not to believe."""

import pytest
import torch
from captures import on_rig
from hypothesis import given
from hypothesis import strategies as st

from mapctl.errors import FileFormatError, RequestError
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks, load_masks, slice_masks


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


def test_a_header_alone_masks_nothing(read):
    assert read("joint,start,stop\n") == ()


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


def test_what_is_no_csv_is_said(tmp_path):
    with pytest.raises(FileFormatError, match="gone"):
        load_masks(tmp_path / "gone.csv")
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(FileFormatError, match="binary"):
        load_masks(tmp_path / "binary.csv")


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


def test_no_masks_hide_nothing(motion):
    joints, root = expand_valid_masks(motion, [])
    assert not joints.any()
    assert not root.any()


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


spans = st.tuples(st.integers(0, 38), st.integers(1, 40)).filter(lambda span: span[0] < span[1])


@given(st.lists(spans, max_size=4), spans)
def test_a_part_of_the_masks_hides_what_they_hide_of_the_part(given_masks, span):
    def frames(masks, count):
        hidden = torch.zeros(count, dtype=torch.bool)
        for mask in masks:
            hidden[mask.start : mask.stop] = True
        return hidden

    masks, (start, stop) = [Mask("j", *pair) for pair in given_masks], span
    part = slice_masks(masks, start, stop)
    assert all(0 <= mask.start < mask.stop <= stop - start for mask in part)
    assert torch.equal(frames(part, stop - start), frames(masks, 40)[start:stop])
