"""Key files: what they may hold, and what is said of what they may not."""

import pytest

from mapctl.errors import FileFormatError, RequestError
from mapctl.intent.keyframe_toml import KeyEntry, KeyRequest, read_keys

TWO = '[[key]]\nframe = 0\npose = "a.bvh"\n[[key]]\nframe = 30\npose = "b.bvh"\n'

LIMB = "reach = { leftHand = [0, 1, 0] }"
DRAWINGS = 'body = "c.bvh"\n[[key]]\nframe = 0\ndrawing = "d.csv"\n[[key]]\nframe = 30\ndrawing = "d.csv"\n'


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
        (f"{TWO}root = true", "key[1].root: there is no such key; the nearest is "),
        ("fps = 30", "key: this key is needed"),
        ("[[key]]\nframe = 0\npose = 'a.bvh'", "in-betweening needs at least two keys, got 1"),
        ("key = []", "in-betweening needs at least two keys, got 0"),
        ("[key]\nframe = 0", "key: "),
        (TWO.replace("frame = 30", "frame = 0"), "key[1]: key[0] is at frame 0 already"),
        (TWO.replace("frame = 30", "seconds = 0.01"), "key[1]: key[0] is at frame 0 already"),
        (TWO.replace("frame = 30", "frame = -1"), "key[1].frame: "),
        (TWO.replace("frame = 30", "frame = 1.5"), "key[1].frame: "),
        (TWO.replace("frame = 30", "frame = true"), "key[1].frame: "),
        (TWO.replace("frame = 30", "seconds = inf"), "key[1].seconds: "),
        (TWO.replace("frame = 30", "frame = 10000000"), "key[1].frame: "),
        (
            f"fps = 1000\n{TWO.replace('frame = 30', 'seconds = 3600')}",
            "key[1].seconds: a motion may have 100000 frames",
        ),
        (TWO.replace("frame = 30", ""), "key[1].frame: a key is at a frame or at seconds, one of them"),
        (f"{TWO}seconds = 1.0", "key[1].frame: a key is at a frame or at seconds, one of them"),
        (TWO.replace("frame = 0", "frame = 4"), "key[0]: the motion begins with its first key, so that is at frame 0"),
        (
            f"{TWO}pose_frame = 1\npose_seconds = 0.1",
            "key[1].pose_frame: a pose is told by pose_frame or by pose_seconds",
        ),
        (f"{TWO}place = [1, nan]", "key[1].place[1]: "),
        (f"{TWO}place = [1, 2, 3]", "key[1].place: "),
        (f"{TWO}place = 'here'", "key[1].place: "),
        (f"{TWO}facing_deg = nan", "key[1].facing_deg: "),
        (f"{TWO}height = 1979-05-27", "key[1].height: "),
        (f"{TWO}reach = {{ a = [1, 2] }}", "key[1].reach.a[2]: "),
        (f"{TWO}joints = ['LeftHand']".replace('pose = "a.bvh"', LIMB, 1), "no key tells where the hips are"),
        (f'{TWO}half = "left"', "key[1].half: input should be 'upper' or 'lower', got \"left\""),
        (f'{TWO}half = "upper"\nroot_only = true', "key[1].half: half and root_only are 2 kinds of keys; choose one"),
        (
            f'{TWO}half = "upper"\ndrawing = "d.csv"\nroot_only = "place"',
            "key[1].half: half and drawing and root_only are 3 kinds of keys; choose one",
        ),
        (f'{TWO}half = "upper"\njoints = ["a"]', "key[1].half: a key tells half or hands and feet; choose one"),
        (f'{TWO}drawing = "d.csv"', "key[1].pose: of a key that is told by a drawing it does not count; leave it out"),
        (f'{TWO}root_only = "plaec"', 'key[1].root_only: it is true, false or "place", got "plaec"'),
        (f"{TWO}root_only = 1", "key[1].root_only: "),
        (
            f'{TWO}root_only = "place"\nheight = 1.0',
            "key[1].height: of a key that is told by a place alone it does not count; leave it out",
        ),
        (f"{TWO}view_deg = 90", "key[1].view_deg: it says from where a drawing is seen, and there is none"),
        (DRAWINGS, "no key tells where the hips are"),
        (DRAWINGS.replace('body = "c.bvh"', ""), "body: this key is needed where no key has a pose"),
        (
            f"{TWO}[[key]]\nframe = 9\npose = 'a.bvh'\nroot_only = true\njoints = ['a']",
            "key[2].root_only: a key tells the root or some joints; choose one",
        ),
        (TWO.replace('pose = "b.bvh"', ""), "key[1].pose: this key is needed where no body is given"),
        (f"fps = 0\n{TWO}", "fps: "),
        (f"fps = nan\n{TWO}", "fps: "),
        (f"{TWO}]", "not TOML: "),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path, text, said):
    path = written(tmp_path, text)
    with pytest.raises(FileFormatError) as caught:
        read_keys(path)
    assert str(caught.value).startswith(f"{path}: {said}")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_text_or_not_there_are_refused(tmp_path):
    (tmp_path / "keys.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(FileFormatError, match="UTF-8"):
        read_keys(tmp_path / "keys.toml")
    with pytest.raises(FileFormatError, match=r"gone\.toml"):
        read_keys(tmp_path / "gone.toml")


def test_a_request_is_checked_however_it_is_made():
    keys = (KeyEntry(frame=0, pose="a.bvh"), KeyEntry(frame=3, pose="a.bvh", root_only=True, half="upper"))
    with pytest.raises(RequestError, match=r"key\[1\]\.half: half and root_only"):
        KeyRequest(keys)
    with pytest.raises(RequestError, match="at least two keys"):
        KeyRequest(keys[:1])


def test_keys_that_are_not_whole_are_read_and_none_need_be(tmp_path):
    text = DRAWINGS.replace("frame = 30", "frame = 30\nplace = [1, 2]\nview_deg = -90")
    more = '[[key]]\nseconds = 0.5\nroot_only = "place"\nplace = [0, 1]\n[[key]]\nseconds = 2\nhalf = "lower"\n'
    request = read_keys(written(tmp_path, text + more))
    assert [key.tells_place for key in request.key] == [False, True, True, True]
    assert [key.needs_pose for key in request.key] == [False, False, False, True]
    assert (request.key[1].drawing, request.key[1].view_deg) == (str(tmp_path / "d.csv"), -90)
    assert str(tmp_path / "d.csv") in request.files
