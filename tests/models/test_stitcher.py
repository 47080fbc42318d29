"""The stitcher: both ends exact, wherever they are, and nothing told but what is told."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_stitcher import CONFIG, network, tiny_stitcher

from controllers.inbetweening.pipeline import CanonicalClip
from mapctl import rotations
from mapctl.features import mirror_features
from mapctl.inbetweening.missing import MissingMask
from mapctl.recording.masks import ALL, Mask
from mapctl.retarget import to_canonical
from priors.stitcher import DrawnLatents, Draws, count_made, join_sides, see_ends, walk_sides

each_length = pytest.mark.parametrize("frames", [2, 3, 4, 5, 8, 15, 24])


def query_of(motion, *gaps):
    masks = [Mask(ALL, start, stop) for start, stop in gaps]
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


def bare(motion, start, stop):
    """Ends of which nothing but the two poses is known."""
    missing = torch.ones(motion.num_frames, dtype=torch.bool)
    missing[[start - 1, stop]] = False
    return see_ends(motion, missing, start, stop)


@each_length
def test_untaught_it_interpolates_places_evenly(frames):
    motion = walk(60, turn_rate=0.6)
    ends = bare(motion, 11, 10 + frames)
    joined = tiny_stitcher(drawn=0.0).answer(ends, frames)
    share = torch.arange(1, frames)[:, None] / frames
    assert joined.root_position.shape == (1, frames - 1, 3)
    heights = motion.root_position[[10, 10 + frames], 1].float()
    torch.testing.assert_close(joined.root_position[0, :, 1], torch.lerp(*heights, share[:, 0]), atol=1e-5, rtol=0)
    assert float(joined.apart.max()) < 1e-3


@each_length
def test_every_length_is_made(frames):
    made = count_made(network(CONFIG), frames)
    ends = bare(walk(60), 11, 10 + frames)
    drawn = DrawnLatents.sample(CONFIG, 1, made, torch.Generator().manual_seed(1))
    joined = join_sides(walk_sides(network(CONFIG), ends, frames, drawn))
    assert joined.quats.shape == (1, frames - 1, 21, 4)
    assert all(bool(getattr(joined, name).isfinite().all()) for name in ("root_position", "quats", "contacts", "apart"))


def test_only_the_poses_of_bare_ends_are_seen():
    motion = walk(60, turn_rate=0.6)
    missing = torch.ones(60, dtype=torch.bool)
    missing[[10, 30]] = False
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    root[missing] += torch.tensor([0.5, 0.2, -0.7]).double()
    quats[missing] = quats[missing].flip(0)
    other = replace(motion, root_position=root, local_quat_xyzw=quats)
    one, two = (tiny_stitcher().answer(see_ends(each, missing, 11, 30), 20) for each in (motion, other))
    assert torch.equal(one.root_position, two.root_position)
    assert torch.equal(one.quats, two.quats)


@pytest.mark.slow
def test_the_pace_of_the_ends_counts_where_it_is_known():
    motion = walk(60, turn_rate=0.6)
    missing = torch.zeros(60, dtype=torch.bool)
    missing[11:30] = True
    known, unknown = see_ends(motion, missing, 11, 30), bare(motion, 11, 30)
    assert known.features.shape[2] == 11
    assert bool((known.paced == 1).all())
    assert bool((unknown.paced == 0).all())
    one, two = (tiny_stitcher().answer(each, 20).root_position for each in (known, unknown))
    assert float((one - two).abs().max()) > 1e-5


def test_the_answer_moves_and_turns_with_its_ends():
    motion = walk(60, turn_rate=0.4)
    turn = rotations.about_y(torch.tensor(2.0).double()).expand(60, 4)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    shift = torch.tensor([400.0, 0.0, -90.0]).double()
    moved = replace(motion, root_position=rotations.rotate(turn, motion.root_position) + shift, local_quat_xyzw=quats)
    one, two = (bare(each, 11, 30) for each in (motion, moved))
    joined, other = (tiny_stitcher().answer(each, 20) for each in (one, two))
    torch.testing.assert_close(joined.root_position, other.root_position, atol=1e-4, rtol=0)


def test_the_calm_answer_to_the_mirror_image_is_the_mirror_image():
    motion = walk(60, turn_rate=0.4)
    ends = bare(motion, 11, 30)
    joined = tiny_stitcher().answer(ends, 20)
    mirrored = replace(
        ends, features=mirror_features(ends.features), place=ends.place * torch.tensor([-1.0, 1.0]), turn=-ends.turn
    )
    flip = torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(
        tiny_stitcher().answer(mirrored, 20).root_position, flip * joined.root_position, atol=1e-5, rtol=0
    )


def test_the_first_draws_do_not_depend_on_the_count_and_differ():
    ends = bare(walk(60), 11, 30)
    few, many = (
        tiny_stitcher().draw(ends, 20, count=count, generator=torch.Generator().manual_seed(3)) for count in (3, 11)
    )
    assert torch.equal(few.quats, many.quats[:3])
    assert len(many.quats) == 11
    assert float((many.quats[0] - many.quats[9]).abs().max()) > 1e-4


def test_gaps_are_filled_between_poses_that_stay_and_too_long_ones_are_named():
    motion = walk(90)
    query = query_of(motion, (10, 25), (40, 70))
    made = tiny_stitcher().propose(query)
    known = ~query.missing.frames
    torch.testing.assert_close(made.motion.root_position[known], motion.root_position[known])
    sources = made.attribute(query)
    assert [source.by for source in sources] == ["stitcher", "interpolation"]
    assert sources[1].reason == "longer than the 23 frames that the stitcher fills"
    step = made.motion.joint_positions()[9:26].diff(dim=0).norm(dim=-1).max()
    assert float(step) < 2 * float(motion.joint_positions().diff(dim=0).norm(dim=-1).max())


@pytest.mark.slow
def test_one_that_draws_gives_the_same_for_the_same_seed_and_number_and_others_for_others():
    query = query_of(walk(60), (20, 40))

    def places(seed, number):
        return tiny_stitcher().drawing(seed).numbered(number).propose(query).motion.root_position

    assert torch.equal(places(1, 9), places(1, 9))
    for other in ((1, 0), (1, 8), (2, 9)):
        assert float((places(1, 9) - places(*other)).abs().max()) > 1e-5


def test_draws_that_are_not_finite_are_dropped_and_counted():
    made = tiny_stitcher().draw(bare(walk(60), 11, 30), 20, count=8, generator=torch.Generator().manual_seed(3))
    made.root_position[[2, 3]] = torch.nan
    draws = Draws(0)

    def pick(number):
        return draws.pick(bare(walk(60), 11, 30), 11, 20, number, lambda noise, heat: made)

    assert torch.equal(pick(2).quats, made.quats[4:5])
    assert torch.equal(pick(1).quats, made.quats[1:2])
    assert draws.dropped == 2
    made.root_position[:] = torch.nan
    assert Draws(0).pick(bare(walk(60), 11, 30), 11, 20, 0, lambda noise, heat: made) is None


def test_an_answer_that_is_not_finite_is_left_to_another():
    broken = tiny_stitcher()
    broken.network.experts.shrink_last(float("nan"))
    source = broken.propose(query_of(walk(60), (20, 40))).others[0]
    assert (source.by, source.reason) == ("interpolation", "nothing finite came of it")
