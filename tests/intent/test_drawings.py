"""Drawings of poses as CSV files, and what is said of those that are none."""

import pytest

from mapctl.errors import FileFormatError
from mapctl.intent.keyframes import Drawing, read_drawing


def test_joints_are_read_by_column_in_any_unit(tmp_path):
    (tmp_path / "pose.csv").write_text("Y,joint,X\n120.5,head,-3\n\n1e2, hips ,0\n")
    assert read_drawing(tmp_path / "pose.csv", 90) == Drawing({"head": (-3.0, 120.5), "hips": (0.0, 100.0)}, 90)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("joint,x,y\n", "the drawing has no joints"),
        ("joint,x\nhead,1\n", "line 1: found the columns 'joint,x', expected joint,x,y"),
        ("joint,x,y\nhead,1,2\nhips,nan,0\n", "line 3: x must be a finite number, got 'nan'"),
        ("joint,x,y\nhead,1\n", "line 2: found 2 values where 3 belong"),
        ("joint,x,y\nhead,1,2\nhead,1,3\n", "line 3: each line names a joint, each once, got 'head'"),
        ("", "the file is empty"),
    ],
)
def test_what_is_no_drawing_is_said_with_its_line(tmp_path, text, said):
    (tmp_path / "pose.csv").write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_drawing(tmp_path / "pose.csv")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
