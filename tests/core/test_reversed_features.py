"""Features run backwards: those that `encode` finds in the motion run backwards, whatever it does and wherever cut."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import walk

from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, GroundPose, encode, integrate_root, reversed_features
from mapctl.pose import decode

WALKS = {
    "left": walk(90, turn_rate=0.9),
    "over the wrap": walk(120, turn_rate=2.5),
    "two frames": walk(40, turn_rate=0.9).slice(20, 22),
}
each_walk = pytest.mark.parametrize("kind", WALKS)


def backwards(motion):
    """The motion played from its end."""
    return replace(motion, root_position=motion.root_position.flip(0), local_quat_xyzw=motion.local_quat_xyzw.flip(0))


@each_walk
def test_they_are_the_features_of_the_motion_run_backwards(kind):
    there, back = (encode(motion)[0] for motion in (WALKS[kind], backwards(WALKS[kind])))
    torch.testing.assert_close(reversed_features(there), back, atol=1e-9, rtol=0)
    if len(there) > 2:
        assert float((reversed_features(there) - there.flip(0)).abs().max()) > 0.01  # not merely the frames in reverse


def test_a_window_needs_nothing_from_outside_itself():
    """The step of a window's first frame is the truth's from before it, and may be anything."""
    motion, (first, stop) = WALKS["left"], (20, 61)
    window = encode(motion)[0][first:stop]
    wanted = encode(backwards(motion))[0][motion.num_frames - stop : motion.num_frames - first]
    found = reversed_features(window)
    torch.testing.assert_close(found[1:], wanted[1:], atol=1e-9, rtol=0)
    arrival = slice(0, 3)
    assert torch.equal(found[0, arrival], found[1, arrival])
    other = window.clone()
    other[0, arrival] = math.nan
    assert torch.equal(reversed_features(other), found)


def test_they_lead_from_the_last_frame_to_the_first():
    motion = WALKS["left"]
    there, start = encode(motion)
    ground, heading = integrate_root(there, start)
    back = reversed_features(there)
    step, turn = LAYOUT.pick(back, "root_displacement_heading"), LAYOUT.pick(back, "heading_change")
    begun = GroundPose(ground[-1], heading[-1]).before(step[0], turn[0, 0])
    torch.testing.assert_close(
        decode(back, begun).joint_positions(), motion.joint_positions().flip(0), atol=1e-8, rtol=0
    )


def test_fewer_than_two_frames_are_refused():
    with pytest.raises(MapctlError, match="at least two frames"):
        reversed_features(torch.zeros(3, 1, LAYOUT.size))
