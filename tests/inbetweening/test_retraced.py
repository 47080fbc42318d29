"""The root trajectory where it is lost: predicted from the body, led to the next known position, all else to the
bit."""

from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import generator, walk
from methods import UNFINISHED
from tiny_path import ToldPath, tiny_path

from controllers import retraced
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.root_trajectory import close_path
from mapctl.motion import Motion
from mapctl.recording.masks import ROOT, Mask
from mapctl.skeleton import CANONICAL, leg_length

FRAMES = 80
CASES = [("canonical", 30), ("bandai", 30), ("daz", 30), ("daz", 120)]


def told_by(motion, stretch=1.0):
    """The motion's own trajectory at the prior's rate and of unit size."""
    canonical = retarget.to_canonical(motion)[0].resample(30)
    scale = leg_length(canonical.skeleton) / leg_length(CANONICAL)
    small = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    return ToldPath(small, stretch)


def hips_of(motion):
    return retarget.to_canonical(motion)[0].root_position


def elsewhere(motion, start, stop):
    """The motion with the hips strewn about in these frames."""
    spread = 3 * torch.randn(stop - start, 3, generator=generator(), dtype=torch.float64)
    if motion.moving_offsets:
        moving = {joint: values.clone() for joint, values in motion.moving_offsets.items()}
        moving[min(moving)][start:stop] += spread
        return replace(motion, moving_offsets=moving)
    root = motion.root_position.clone()
    root[start:stop] += spread
    return replace(motion, root_position=root)


@pytest.mark.parametrize(("rig", "fps"), CASES)
def test_a_true_prediction_gives_back_the_way_and_what_is_known_stays_to_the_bit(rig, fps):
    motion = on_rig(rig, FRAMES * fps // 30, fps=fps)
    start, stop = fps // 2, 2 * fps
    masks = [Mask(ROOT, start, stop)]
    done = retraced(elsewhere(motion, start, stop), told_by(motion), masks, settings=UNFINISHED)
    assert float((hips_of(done.motion) - hips_of(motion)).norm(dim=-1).max()) < (0.005 if fps == 30 else 0.01)
    lost = MissingMask.of_masks(motion, masks, retarget.to_canonical(motion)[1])
    assert torch.equal(done.motion.local_quat_xyzw, motion.local_quat_xyzw)
    assert torch.equal(done.motion.root_position[~lost.root], motion.root_position[~lost.root])
    for joint, values in motion.moving_offsets.items():
        assert torch.equal(done.motion.moving_offsets[joint][~lost.root], values[~lost.root])


@pytest.mark.parametrize("edges", [(20, 60), (0, 50), (30, FRAMES), (0, FRAMES)])
def test_where_the_hips_were_while_they_are_lost_does_not_matter(edges):
    motion, masks = walk(FRAMES), [Mask(ROOT, *edges)]
    found = [
        retraced(each, tiny_path(), masks, settings=UNFINISHED).motion for each in (motion, elsewhere(motion, *edges))
    ]
    assert torch.equal(found[0].root_position, found[1].root_position)
    assert bool(found[0].root_position.isfinite().all())


def test_who_stands_is_not_moved_by_what_the_walk_after_it_misses():
    """20 frames of standing, then 20 of walking, which end 10 cm beside the place that is known."""
    steps = torch.zeros(42, 3)
    steps[21:, 2] = 0.04
    predicted = torch.cumsum(steps, dim=0)
    known = predicted.clone()
    known[41:, 0] = 0.1
    lost = torch.zeros(42, dtype=torch.bool)
    lost[1:41] = True
    found = close_path(predicted, known, lost)
    assert float((found[:21] - predicted[:21]).abs().max()) < 0.001
    assert float(torch.diff(found[:, 0]).max()) < 0.006
    assert float((found[40] - known[41]).norm()) < 0.05


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ([Mask(ROOT, 10, 90)], "ends after the motion's 80 frames"),
        ([Mask(ROOT, 0, FRAMES), Mask("leftHand", 5, 9)], "over all frames of a motion whose joints are lost as well"),
        ([Mask("leftHand", 5, 9)], "there is nothing to predict"),
        ([Mask("leftElbow7", 5, 9)], "no joint"),
        ([], "nothing to predict"),
    ],
)
def test_masks_that_do_not_fit_are_refused(masks, message):
    with pytest.raises(RequestError, match=message):
        retraced(walk(FRAMES), tiny_path(), masks, inbetweener=SlerpInbetweener(), settings=UNFINISHED)
