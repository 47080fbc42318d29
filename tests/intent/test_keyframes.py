"""Key files and drawings: what they may hold, and the errors of what they may not."""

import pytest

from mapctl.errors import FileFormatError
from mapctl.intent.keyframes import Drawing, KeyEntry, read_drawing, read_keys

TWO = '[[key]]\nframe = 0\npose = "a.bvh"\n[[key]]\nframe = 30\npose = "b.bvh"\n'


def written(tmp_path, text):
    path = tmp_path / "keys.toml"
    path.write_text(text)
    return path


def test_files_are_found_beside_the_key_file_and_times_become_frames(tmp_path):
    request = read_keys(written(tmp_path, f'fps = 24\nbody = "c.bvh"\n{TWO}[[key]]\nseconds = 0.5\nroot_only = true'))
    assert (request.fps, request.body) == (24, str(tmp_path / "c.bvh"))
    assert [key.pose for key in request.key] == [str(tmp_path / "a.bvh"), str(tmp_path / "b.bvh"), None]
    assert [request.frame_of(key) for key in request.key] == [0, 30, 12]


def test_all_keys_of_a_table_are_read(tmp_path):
    more = (
        "[[key]]\nframe = 9\npose = 'a.bvh'\npose_seconds = 1.5\nplace = [1, -2.5]\nheight = 0.8\n"
        "facing_deg = -90\njoints = ['LeftFoot']\nreach = { LeftHand = [0.5, 1.5, 2] }\n"
    )
    key = read_keys(written(tmp_path, TWO + more)).key[2]
    assert key == KeyEntry(
        frame=9,
        pose=str(tmp_path / "a.bvh"),
        pose_seconds=1.5,
        place=(1, -2.5),
        height=0.8,
        facing_deg=-90,
        joints=("LeftFoot",),
        reach={"LeftHand": (0.5, 1.5, 2)},
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TWO.replace("pose =", "poze =", 1), "key[0].poze: there is no such key; the nearest is pose; allowed: "),
        (f"fsp = 30\n{TWO}", "fsp: there is no such key; the nearest is fps; allowed: "),
        ("key = []", "in-betweening needs at least two keys, got 0"),
        (TWO.replace("frame = 30", "seconds = 0.01"), "key[1]: key[0] is at frame 0 already"),
        (TWO.replace("frame = 30", "frame = 1.5"), "key[1].frame: "),
        (TWO.replace("frame = 30", "seconds = inf"), "key[1].seconds: "),
        (TWO.replace("frame = 30", "frame = 10000000"), "key[1].frame: "),
        (TWO.replace("frame = 30", ""), "key[1].frame: a key is at a frame or at seconds, one of them"),
        (
            f"{TWO}pose_frame = 1\npose_seconds = 0.1",
            "key[1].pose_frame: a pose is given by pose_frame or by pose_seconds",
        ),
        (f"{TWO}place = [1, nan]", "key[1].place[1]: "),
        (f'{TWO}root_only = "plaec"', 'key[1].root_only: it is true, false or "place", got "plaec"'),
        (f"{TWO}view_deg = 90", "key[1].view_deg: it is the view of a drawing, and there is none"),
        (f"fps = nan\n{TWO}", "fps: "),
        (f"{TWO}]", "not TOML: "),
    ],
)
def test_faults_are_reported_with_their_position(tmp_path, text, said):
    path = written(tmp_path, text)
    with pytest.raises(FileFormatError) as caught:
        read_keys(path)
    assert str(caught.value).startswith(f"{path}: {said}")
    assert "\n" not in str(caught.value)


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
def test_an_invalid_drawing_is_refused_with_its_line(tmp_path, text, said):
    (tmp_path / "pose.csv").write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_drawing(tmp_path / "pose.csv")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
