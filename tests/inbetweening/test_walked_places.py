"""Places that are all that keys tell: a curve through them in time, and who walks it."""

import pytest
import torch
from captures import on_rig
from tiny_prior import save_tiny_prior
from tiny_tweener import tiny_tweener

import priors
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener, lay_curve
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.effector_targets import LooseKeys
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Key, Keys
from mapctl.skeleton import CANONICAL

FRAMES = (0, 30, 75, 90)
WAY = ((0.0, 0.0), (0.5, 1.2), (0.5, 2.6), (-0.4, 3.0))
FASTEST = 2.0  # m/s


def query_of(frames=FRAMES, way=WAY, *, drawn=False):
    loose = LooseKeys.none(91, CANONICAL.num_joints)
    loose.placed[list(frames)] = True
    loose.ground[list(frames)] = torch.tensor(way).double()
    loose.drawn[0] = drawn
    missing = MissingMask.of_frames(torch.ones(91, dtype=torch.bool), CANONICAL.num_joints)
    return GapQuery(on_rig("canonical", 91), missing, torch.arange(91).double() / 30, loose=loose)


def test_the_curve_is_at_every_place_in_its_frame_and_goes_on():
    curve, arcs = lay_curve(query_of(), FASTEST, 20)
    assert len(arcs) == 111
    assert (torch.diff(arcs) > 0).all()
    found = curve.ground_point(arcs[list(FRAMES)])
    torch.testing.assert_close(found, torch.tensor(WAY).double(), atol=0.02, rtol=0)


@pytest.mark.parametrize(
    "query",
    [
        query_of(drawn=True),
        query_of((0, 30, 75), WAY[:3]),  # the end is open
        query_of(way=((0.0, 0.0), (0.5, 1.2), (0.5, 1.3), (-0.4, 1.5))),  # stands in between
        query_of(way=((0.0, 0.0), (0.5, 1.2), (0.5, 2.6), (-0.4, 9.0))),  # faster than anybody in the data
    ],
    ids=["drawn", "open", "stands", "too fast"],
)
def test_what_is_no_walk_is_left_to_others(query):
    assert lay_curve(query, FASTEST, 5) is None


@pytest.mark.slow
def test_auto_walks_over_places_where_a_density_does_and_says_so(tmp_path):
    motion = on_rig("bandai", 60)
    keys = Keys((Key(0, root_only="place"), Key(59, root_only="place")))
    density = priors.load(str(save_tiny_prior(tmp_path / "prior.safetensors")))
    auto = AutoInbetweener(SlerpInbetweener(), [density], tweener=tiny_tweener())
    result = tween(motion, keys, auto, settings=InfillSettings(refine=False))
    assert all(row["missed_cm"] < 1e-6 for row in measure_keyframe_errors(result.motion, motion, keys))
    assert result.gap_notes[0].startswith("frames 0:60: walk of ")
    whole = tween(motion, Keys((0, keys.each[1])), auto, settings=InfillSettings(refine=False))
    assert not any("walk of" in note for note in whole.gap_notes)
