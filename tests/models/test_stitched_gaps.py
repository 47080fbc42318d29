"""Stitched gaps, and who fills what cannot be stitched."""

import pytest
import torch
from helpers import walk
from test_stitcher import query_of
from tiny_stitcher import tiny_stitcher

from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener, StitchedInbetweener
from controllers.inbetweening.tween import tween
from mapctl.intent.keyframes import Keys

RAW = InfillSettings(finish=False)


def never():
    raise AssertionError("nothing was left to the other")


def stitched(load=never):
    return StitchedInbetweener(tiny_stitcher(), load)


@pytest.mark.slow
def test_the_other_is_not_loaded_where_all_is_stitched():
    query = query_of(walk(90), (10, 25), (40, 60))
    made, alone = stitched().propose(query), tiny_stitcher().propose(query)
    assert torch.equal(made.motion.root_position, alone.motion.root_position)
    assert [source.by for source in made.attribute(query)] == ["stitcher", "stitcher"]
    assert all(0 <= source.apart < 1 for source in made.attribute(query))


def test_gaps_that_are_too_long_or_have_one_end_are_the_others_and_the_rest_stays_stitched():
    query = query_of(walk(90), (10, 25), (40, 70), (80, 90))
    made, alone = stitched(SlerpInbetweener).propose(query), tiny_stitcher().propose(query)
    assert torch.equal(made.motion.local_quat_xyzw[10:25], alone.motion.local_quat_xyzw[10:25])
    slerp = SlerpInbetweener().propose(query).motion
    assert torch.equal(made.motion.local_quat_xyzw[40:], slerp.local_quat_xyzw[40:])
    first, second, third = made.attribute(query)
    assert (first.by, first.reason) == ("stitcher", "")
    assert (second.by, second.reason) == ("slerp", "longer than the 23 frames that the stitcher fills")
    assert (third.by, third.start, third.stop) == ("slerp", 80, 90)
    assert third.reason.startswith("known in part or on one side alone")


def test_where_nothing_can_be_stitched_all_is_the_others():
    query = query_of(walk(90), (30, 70))
    made = stitched(SlerpInbetweener).propose(query)
    assert torch.equal(made.motion.root_position, SlerpInbetweener().propose(query).motion.root_position)
    assert made.source == "slerp"


@pytest.mark.slow
@pytest.mark.parametrize("limbs", [(), ("leftHand",)])
def test_hands_on_the_way_are_reached(limbs):
    """Between whole poses the stitcher fills a gap with a hand told in it too."""
    motion, keys = walk(60), Keys.of([20, 30, 40], limbs=limbs)
    done = tween(motion, keys, stitched(SlerpInbetweener), settings=RAW)
    bys = {source.by for source in done.sources if 20 < source.start < 40}
    assert bys == {"stitcher"}
    if limbs:
        hand = motion.skeleton.indices(["leftHand"])
        off = (done.motion.joint_positions() - motion.joint_positions())[30, hand].norm()
        assert float(off) < 1e-3


def test_what_was_stitched_is_reported():
    done = tween(walk(60), Keys.of([0, 20, 59]), stitched(SlerpInbetweener), settings=RAW)
    told = done.details()
    assert 0 <= told["sides_apart_cm"] < 100
    assert [(row["by"], row["start"], row["stop"]) for row in told["fallback"]] == [("slerp", 21, 59)]
    assert told["timing"]["draw_ms"] > 0
    assert told["timing"]["finish_ms"] > 0
