"""Copies of clips at other tempos and with other strides are motions: feet stand, contacts hold, headings stay."""

import pytest
import torch
from helpers import generator, walk
from performers import Performer

from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode
from mapctl.pose import BodyPose
from mapctl.skeleton import TOE_JOINTS
from priors.training.augment import add_copies, copy_clip
from priors.training.data import Corpus
from priors.training.windows import PoseWindows

pytestmark = pytest.mark.usefixtures("small_judgements")
FACTORS = [(1.15, 1.0), (0.85, 1.0), (1.0, 1.1), (1.0, 0.9), (1.12, 1.08), (0.9, 0.93)]


def corpus_of(*motions):
    clips = [encode(motion)[0].float() for motion in motions]
    return Corpus(tuple(f"{k}/walk_{k}.bvh" for k in range(len(clips))), tuple(map(len, clips)), torch.cat(clips))


@pytest.fixture(scope="module")
def corpus():
    """A walk whose planted toes do not move at all, one that turns, and one who stands."""
    turning = walk(90, turn_rate=0.6)
    return corpus_of(Performer(upright=0.88).walks(120), turning, Performer().stands(60))


@pytest.fixture(scope="module")
def windows(corpus):
    return PoseWindows(corpus, evenness=0.0)


def decoded(features):
    """World positions of joints on canonical bones, planted toes, and the features."""
    positions = BodyPose.of_features(features.double(), GroundPose.origin(torch.float64)).joints_world()
    return positions, positions[:, list(TOE_JOINTS)], features[:, LAYOUT.slices["contacts"]] > 0.5


def slide(toes, planted):
    """Speeds of planted toes over the ground, m/s."""
    return (torch.diff(toes, dim=0)[..., ::2].norm(dim=-1) * PRIOR_FPS)[planted[1:] & planted[:-1]]


@pytest.mark.parametrize(("tempo", "strides"), FACTORS)
def test_feet_that_stand_stand_in_a_copy(corpus, windows, tempo, strides):
    before, after = decoded(corpus.clips()[0]), decoded(copy_clip(windows, 0, tempo=tempo, strides=strides))
    for _, toes, planted in (before, after):
        assert slide(toes, planted).quantile(0.9) < 0.01
        # The first frame and the last of a contact are those of a toe that comes and goes.
        assert slide(toes, planted).max() < 0.35 * tempo
    heights = [toes[..., 1][planted] for _, toes, planted in (before, after)]
    assert float((heights[1].median() - heights[0].median()).abs()) < 1e-3
    assert after[1][..., 1].min() > before[1][..., 1].min() - 2e-3


@pytest.mark.parametrize(("tempo", "strides"), FACTORS)
def test_ways_and_turns_are_in_proportion(corpus, windows, tempo, strides):
    for number, clip in enumerate(corpus.clips()):
        copy = copy_clip(windows, number, tempo=tempo, strides=strides)
        assert len(copy) == int((len(clip) - 1) / tempo) + 1
        turns = [float(LAYOUT.pick(features, "heading_change")[1:].sum()) for features in (clip, copy)]
        # The last frame of a copy may lie before the last of its clip by less than a step.
        assert turns[1] == pytest.approx(turns[0], abs=0.6 / PRIOR_FPS * tempo + 1e-3)
        ways = [decoded(features)[0][:, 0, ::2] for features in (clip, copy)]
        far = [float((way[-1] - way[0]).norm()) for way in ways]
        assert far[1] == pytest.approx(strides * far[0], abs=0.05)
        speeds = [LAYOUT.pick(f, "root_displacement_heading").norm(dim=-1).mean() for f in (clip, copy)]
        assert float(speeds[1]) == pytest.approx(float(tempo * strides * speeds[0]), abs=3e-4)


@pytest.mark.slow
def test_copies_come_after_their_clips_with_their_names_and_the_seed_draws_them(corpus):
    one, again, other = (add_copies(corpus, 2, generator(seed)) for seed in (1, 1, 2))
    assert one.names == corpus.names * 3
    assert one.lengths[:3] == corpus.lengths
    assert torch.equal(one.features[: len(corpus.features)], corpus.features)
    assert torch.equal(one.features, again.features)
    assert one.lengths != other.lengths
    assert one.lengths[3:6] != one.lengths[6:9]
    least, most = (corpus.lengths[0] / factor for factor in (1.15, 0.85))
    assert all(least - 1 <= length <= most + 1 for length in (one.lengths[3], one.lengths[6]))
    spread = [one.features[:, LAYOUT.slices["root_height"]], corpus.features]
    assert all(map(lambda part: bool(torch.isfinite(part).all()), spread))
