"""The picture of a rig as it was understood: labels that do not cover each other, names of any script, every joint."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import bandai_skeleton, walk
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rig_maker import Make, make, names_of, person
from rig_trees import TREES
from strange_rigs import CASES

from mapctl import retarget
from mapctl.retarget.doubts import assess_fit
from mapctl.skeleton import CANONICAL
from scenes.plots import rig_picture
from scenes.plots.rig_picture import RigPicture, plot_rig, printable, shorten, spread


def picture_of(motion):
    """As `mapctl info` makes it."""
    rigmap = retarget.to_canonical(motion)[1]
    return RigPicture(rigmap, motion, assess_fit(rigmap, motion), "clip.bvh")


def drawn(picture):
    """What measures its texts, and they."""
    figure = Figure(figsize=(16.0, 9.6), dpi=100)
    rig_picture._draw(figure, picture)
    texts = [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]
    return FigureCanvasAgg(figure).get_renderer(), [text for text in texts if text.get_text()]


@given(st.lists(st.floats(-0.5, 1.5), max_size=16))
def test_labels_stay_apart_in_their_order_and_within_the_column(heights):
    heights = sorted(heights, reverse=True)
    placed = spread(heights)
    steps = -np.diff(placed)
    assert (steps >= min(0.056, 0.93 / max(len(heights) - 1, 1)) - 1e-9).all()
    assert all(0.03 < height < 0.97 for height in placed)


def test_labels_that_have_room_stay_where_their_joints_are():
    assert spread([0.9, 0.5, 0.1]) == [0.9, 0.5, 0.1]
    assert spread([0.5, 0.5]) == pytest.approx([0.5, 0.444])


@pytest.mark.slow
@pytest.mark.parametrize(
    "motion",
    [
        retarget.from_canonical(walk(6), retarget.identify_rig(bandai_skeleton())),
        make(Make(names_of("mixamo"), zup=True, arms_down_deg=40, size=1.4)).motion(person(1.4, 6)),
        make(replace(TREES["mmd", "Japanese"], extras=False)).motion(person(1.0, 6)),
        CASES["no words"].motion,
        CASES["two people by name"].motion,
        CASES["one long shin"].motion,
        CASES["too large"].motion,
    ],
    ids=["Bandai Namco", "Mixamo", "MMD", "no words", "two people", "one long shin", "too large"],
)
def test_every_joint_has_its_label_and_no_label_covers_another(motion):
    picture = picture_of(motion)
    renderer, texts = drawn(picture)
    words = [text.get_text() for text in texts]
    for name, own in picture.rigmap.joint_names.items():
        assert any(word == name or word.startswith(name + " [") for word in words)
        assert shorten(printable(own)) in words
    boxes = [text.get_window_extent(renderer) for text in texts]
    for k, box in enumerate(boxes):
        for other, word in zip(boxes[:k], words[:k], strict=True):
            apart = min(box.x1, other.x1) - max(box.x0, other.x0), min(box.y1, other.y1) - max(box.y0, other.y0)
            assert min(apart) < 1.5, (words[k], word)  # pixels
        assert min(box.x0, box.y0, 1600 - box.x1, 960 - box.y1) >= 0, words[k]


def test_doubts_are_told_by_number_beside_their_joints():
    picture = picture_of(CASES["one name lost"].motion)
    words = [text.get_text() for text in drawn(picture)[1]]
    assert "leftHand [1]" in words
    assert "[1] leftHand is known by its position alone (joint 'a17')" in words
    assert "fit: doubtful" in words
    assert "rightHand" in words


def test_the_t_pose_and_frames_stand_upright_and_face_the_viewer():
    made = make(Make(names_of("mixamo"), zup=True, turned_deg=90, arms_down_deg=30, root="Ground"))
    picture = picture_of(made.motion(person(1.0, 8)))
    joints = picture.rigmap.joints
    tpose = picture.tpose()
    assert tpose[joints["head"], 1] - tpose[joints["hips"], 1] > 0.4
    assert tpose[joints["leftHand"], 0] > 0.5 > -0.5 > tpose[joints["rightHand"], 0]
    assert tpose[joints["leftToes"], 2] - tpose[joints["leftFoot"], 2] > 0.05
    first = picture.frame(0)
    assert np.abs(first[joints["hips"], [0, 2]]).max() < 1e-9
    assert first[joints["leftUpperLeg"], 0] > first[joints["rightUpperLeg"], 0]
    assert first[joints["head"], 1] > first[joints["hips"], 1] + 0.4
    assert made.skeleton.names.index("Ground") not in picture.shown
    assert set(picture.shown) >= set(joints.values())


def test_a_hand_that_is_no_canonical_joint_is_grey_and_a_twist_in_the_arm_is_not():
    made = make(replace(TREES["daz-genesis", "3 and 8"], extras=False))
    picture = picture_of(made.motion(person(1.0, 4)))
    names = picture.rigmap.rig_skeleton.names
    assert picture.colours[names.index("lShldrTwist")] == picture.colours[names.index("lForearmBend")]
    assert names.index("lThumb1") not in picture.colours
    assert len(set(picture.colours.values())) == 3


def test_names_of_other_scripts_are_shown_by_what_the_fonts_hold():
    assert printable("LeftHand") == "LeftHand"
    assert printable("左手") in ("左手", "\\u5de6\\u624b")
    assert len(shorten("a" * 60)) <= 24
    assert shorten("mixamorig:LeftUpLeg") == "mixamorig:LeftUpLeg"


@pytest.mark.slow
def test_a_picture_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    picture = picture_of(CASES["Mixamo"].motion)
    plot_rig(picture, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(rig_picture, "_write_key", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        plot_rig(picture, tmp_path / "b.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_rig_that_lacks_joints_says_which():
    names = {c: own for c, own in names_of("mixamo").items() if "Toes" not in c}
    picture = picture_of(make(Make(names, extras=False)).motion(person(1.0, 4)))
    assert "the rig has no leftToes, rightToes" in [text.get_text() for text in drawn(picture)[1]]
    assert picture.rigmap.skeleton.num_joints == CANONICAL.num_joints
