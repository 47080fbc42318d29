"""Retrieval: the window itself is found, wherever it stands and faces, and its ends are met."""

from dataclasses import replace

import pytest
import torch
from captures import on_rig

from mapctl import rotations
from mapctl.inbetweening.retrieval import MotionCollection, bend_to_ends


def turned(motion, angle, shift):
    turn = rotations.about_y(torch.tensor(angle, dtype=torch.float64))
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn.expand(len(quats), 4), quats[:, 0])
    root = rotations.rotate(turn.expand(len(quats), 4), motion.root_position) + torch.tensor(shift).double()
    return replace(motion, root_position=root, local_quat_xyzw=quats)


CLIPS = [on_rig("canonical", 60), on_rig("canonical", 45).mirror()]
COLLECTION = MotionCollection.of(CLIPS)


@pytest.mark.parametrize(("clip", "start"), [(0, 7), (1, 20)])
def test_a_window_of_the_collection_is_found_and_comes_back_where_it_is_asked(clip, start):
    wanted = turned(CLIPS[clip].slice(start, start + 16), 1.9, (3.0, 0.0, -2.0))
    first, last = wanted.slice(0, 1), wanted.slice(15, 16)
    (found,) = COLLECTION.find_nearest(first, last, 15)
    assert torch.equal(found.root_position, CLIPS[clip].slice(start, start + 16).root_position)
    made = bend_to_ends(found, first, last)
    torch.testing.assert_close(made.joint_positions(), wanted.joint_positions(), atol=1e-6, rtol=0)


def test_ends_are_met_by_whatever_is_bent():
    clip = CLIPS[0]
    first, last = turned(clip.slice(3, 4), 0.4, (1.0, 0.0, 1.0)), turned(clip.slice(30, 31), -0.3, (2.0, 0.0, 1.5))
    made = bend_to_ends(clip.slice(8, 28), first, last)
    for at, end in ((0, first), (19, last)):
        torch.testing.assert_close(made.joint_positions()[at], end.joint_positions()[0], atol=1e-6, rtol=0)


def test_windows_do_not_span_two_clips():
    with pytest.raises(ValueError, match="no clip has 62 frames"):
        COLLECTION.find_nearest(CLIPS[0].slice(0, 1), CLIPS[0].slice(5, 6), 61)


def test_the_nearest_of_each_clip_come_in_order_and_only_those_that_are_near():
    wanted = CLIPS[1].slice(20, 36)
    first, last = wanted.slice(0, 1), wanted.slice(15, 16)
    both = COLLECTION.find_nearest(first, last, 15, 5)
    assert torch.equal(both[0].root_position, wanted.root_position)
    assert any(
        torch.equal(both[1].root_position, CLIPS[0].slice(start, start + 16).root_position) for start in range(45)
    )
    assert len(both) == 2  # one of each clip
    assert len(COLLECTION.find_nearest(first, last, 15, 5, within=1e-4)) == 1
    assert len(COLLECTION.find_nearest(first, last, 50, 5)) == 1  # the other clip is too short
