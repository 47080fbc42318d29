"""The tweener told how to move: by poses, by classes, in gaps beyond what its network sees, beside others in auto."""

from dataclasses import replace

import pytest
import tiny_tweener
import torch
from helpers import walk
from test_tweener import query_of, standing
from tiny_tweener import tiny_tweener as make_tweener

from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener
from mapctl import motion_dna
from mapctl.kinematics import heading
from mapctl.motion_dna import MotionDna
from mapctl.skeleton import TOE_JOINTS, TOE_REST_HEIGHT
from priors.tweener import Style, find_splits, mix_styles, place_poses, read_classes, show_edges

FAST = motion_dna.of(walk(90, cadence=1.4, seed=5))


def furthest(one, other):
    """How far rotations of two motions are apart, the most of all joints, by frame."""
    return (one.local_quat_xyzw - other.local_quat_xyzw).abs().amax(dim=(1, 2))


def test_a_style_changes_what_is_made_and_keeps_the_keys():
    query, plain = query_of(walk(120), (1, 119)), make_tweener()
    styled = plain.styled(FAST)
    assert (plain.has_style, styled.has_style) == (False, True)
    one, other = (each.propose(query) for each in (plain, styled))
    assert (one.source, other.source) == ("tweener", "tweener in the style of motion DNA")
    apart = furthest(one.motion, other.motion)
    assert float(apart[30:90].max()) > 1e-3
    assert float(apart[[0, 119]].max()) == 0


def test_a_class_of_the_card_is_a_style_without_poses():
    card = tiny_tweener.card(classes=("walk", "dance-on"))
    classes = read_classes(card, tiny_tweener.CONFIG.style)
    assert set(classes) == {"walk", "dance-on"}
    plain, query = make_tweener(), query_of(walk(120), (1, 119))
    made = [plain.in_style(style).propose(query).motion for style in classes.values()]
    assert float(furthest(*made)[30:90].max()) > 1e-4
    assert all(style.poses is None for style in classes.values())


@pytest.mark.slow
def test_a_long_gap_is_split_by_poses_of_the_style_or_of_the_keys_and_a_note_says_so():
    query, plain = query_of(walk(600), (10, 580)), make_tweener()
    made = {}
    for tweener, by in ((plain, "the keys beside it"), (plain.styled(FAST), "the style")):
        answer = tweener.propose(query)
        (source,) = answer.attribute(query)
        assert (source.start, source.stop) == (10, 580)
        assert source.reason == f"longer than the 16 s that the tweener sees; split at 6.7, 13.0 s by poses of {by}"
        made[by] = answer.motion
    nothing = replace(plain, style=Style("nothing", plain.encode_style(FAST).vector))
    assert float(furthest(made["the style"], nothing.propose(query).motion)[150:450].max()) > 1e-3
    short = query_of(walk(120), (10, 100))
    assert not plain.propose(short).attribute(short)[0].reason


def test_poses_that_split_a_gap_stand_on_the_way_and_face_along_it():
    query = query_of(walk(1100, turn_rate=0.05), (1, 1099))
    (split,) = find_splits(query)
    assert split.frames == [221, 440, 660, 879]
    body = query.to_unit_size(query.motion)
    placed = place_poses(FAST.poses, body, split.frames)
    assert float((placed[:, 0] - body.root_position[split.frames])[:, ::2].abs().max()) < 1e-6
    torch.testing.assert_close(placed[:, list(TOE_JOINTS), 1].amin(dim=1), torch.full((4,), TOE_REST_HEIGHT).double())
    across = (placed[:, 13] - placed[:, 17])[:, ::2]  # from the right upper leg to the left
    own = FAST.poses[[number * len(FAST.poses) // 4 for number in range(4)]]
    first = (own[:, 13] - own[:, 17])[:, ::2]
    turned = torch.atan2(across[:, 0], across[:, 1]) - torch.atan2(first[:, 0], first[:, 1])
    off = turned - heading(body.local_quat_xyzw[split.frames, 0])
    assert float(torch.sin(off / 2).abs().max()) < 1e-4


def test_the_poses_beside_a_gap_are_whole_ones():
    query = query_of(walk(600), (10, 580))
    (split,) = find_splits(query)
    wanted = motion_dna.of_rotations(walk(600).local_quat_xyzw[580:581], 1).poses[0]
    torch.testing.assert_close(show_edges(query, split)[0], wanted)
    joints = query.missing.joints.clone()
    joints[:, 3] = True
    bare = replace(query, missing=replace(query.missing, joints=joints))
    assert len(show_edges(bare, split)) == 0
    (source,) = make_tweener().propose(bare).attribute(bare)
    assert source.reason.endswith("; give more keys")


def test_poses_on_the_way_are_come_near_in_place_of_what_was_before():
    """The network that copies what is nearest takes the told pose in the middle of the gap."""
    query, tweener = query_of(walk(600), (1, 599)), make_tweener()
    told = tweener._tell_poses(query, list(find_splits(query)))
    alone, split = (tweener._make(query, each)[0] for each in ({}, told))
    assert set(told) == {200, 400}
    moved = (alone - split).abs().amax(dim=(1, 2))
    assert float(moved[180:220].max()) > 1e-4


@pytest.mark.slow
def test_auto_gives_the_tweener_what_has_room_for_a_style_and_holds_nobody():
    query = query_of(walk(200), (1, 30), (31, 100), (101, 199))
    styled = AutoInbetweener(SlerpInbetweener(), tweener=make_tweener().styled(FAST))
    assert styled.has_style
    sources = styled.propose(query).attribute(query)
    name = "tweener in the style of motion DNA"
    assert [source.by for source in sources] == ["slerp", name, name]
    assert sources[0].reason == "too short, or with parts told, for a style"
    plain = AutoInbetweener(SlerpInbetweener(), tweener=make_tweener()).propose(query).attribute(query)
    assert {source.by for source in plain} == {"slerp"}
    still = query_of(standing(200), (1, 199))
    assert [source.by for source in styled.propose(still).attribute(still)] == [name]


def test_several_styles_are_mixed():
    tweener = make_tweener()
    one, other = tweener.encode_style(FAST, "one"), Style("other", torch.ones(5))
    mixed = mix_styles([one, other])
    assert mixed.name == "one and other"
    torch.testing.assert_close(mixed.vector, (one.vector + 1) / 2)
    assert mixed.poses is not None
    assert len(mixed.poses) == len(FAST.poses)
    assert mix_styles([other]).poses is None
    both = motion_dna.join([FAST, MotionDna(FAST.poses.flip(0))])
    torch.testing.assert_close(tweener.encode_style(both).vector, one.vector)
