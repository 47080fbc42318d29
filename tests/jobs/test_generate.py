"""Random generation with an untrained density: lengths, seeds, starts, and pieces that join."""

import math
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise

import pytest
import torch
from helpers import bandai_skeleton, generator, tiny_density, turn_between, walk
from toy_density import ToyDensity, toy_density

from controllers.generation.generate import (
    Beginning,
    GenerateSettings,
    draw_paces,
    generate,
    initialise_generation,
    plan_paces,
    sample_pieces,
    sample_stratified_starts,
    stream,
)
from mapctl import retarget
from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.kinematics import heading
from mapctl.pose import decode
from mapctl.protocols import LastFrameState
from mapctl.skeleton import CANONICAL

DENSITY = replace(tiny_density(), use_fast=False)
RAW = GenerateSettings(foot_cleanup=None)


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch):
    """Draws are made a piece at a time: the whole piece of 20 s for one second of motion else."""
    monkeypatch.setattr(sys.modules["controllers.generation.generate"], "_CHUNK", 50)


def result(seconds=1.0, *, seed=0, settings=RAW, **options):
    return generate(DENSITY, seconds=seconds, generator=generator(seed), settings=settings, **options).motion


@pytest.mark.parametrize(("seconds", "frames"), [(0.5, 15), (0.001, 2), (1.51, 45)])
def test_it_is_as_long_as_asked(seconds, frames):
    motion = result(seconds)
    assert (motion.num_frames, motion.fps) == (frames, 30)
    assert motion.skeleton is CANONICAL
    assert bool(torch.isfinite(motion.joint_positions()).all())


@pytest.mark.slow
def test_pieces_join_to_the_motion_sampled_in_one_go(monkeypatch):
    whole = result(2.0, seed=5)
    monkeypatch.setattr(sys.modules["controllers.generation.generate"], "_CHUNK", 13)
    pieces = list(stream(DENSITY, seconds=2.0, generator=generator(5), settings=RAW))
    assert [piece.motion.num_frames for piece in pieces] == [13, 13, 13, 13, 8]
    joined = result(2.0, seed=5)
    torch.testing.assert_close(joined.joint_positions(), whole.joint_positions(), atol=1e-6, rtol=0)
    assert turn_between(joined.local_quat_xyzw, whole.local_quat_xyzw) < 1e-6
    dots = (joined.local_quat_xyzw[1:] * joined.local_quat_xyzw[:-1]).sum(-1)
    assert float(dots.min()) > 0


def test_it_is_what_the_prior_samples_from_the_chosen_start():
    motion = result(0.5, seed=3, settings=replace(RAW, start=2, temperature=0.5))
    draws = generator(3)
    torch.multinomial(DENSITY.initial_states.weight, 1, generator=draws)
    state = DENSITY.initial_states.state.pick(torch.tensor([2]))
    features, _ = DENSITY.sample(state, 20, draws, temperature=0.5)
    torch.testing.assert_close(encode(motion)[0][1:, 2:66], features[0, 1:15, 2:66].double(), atol=1e-5, rtol=0)


def test_temperature_spreads_the_draws():
    one = tiny_density(components=1)
    calm, wild = (
        generate(one, seconds=2.0, generator=generator(), settings=replace(RAW, temperature=t, start=0)).motion
        for t in (0.0, 2.0)
    )
    jerks = [encode(m)[0][:, 6:66].diff(n=3, dim=0).square().mean().sqrt() for m in (calm, wild)]
    assert float(jerks[1]) > 2 * float(jerks[0])


@pytest.mark.parametrize("rig", ["canonical", "bandai", "60 fps"])
def test_it_continues_where_a_clip_ends(rig):
    clip = walk(40, turn_rate=0.8, fps=60 if rig == "60 fps" else 30)
    if rig == "bandai":
        clip = retarget.from_canonical(clip, retarget.identify_rig(bandai_skeleton()))
    end = retarget.to_canonical(clip)[0]
    motion = result(start_clip=clip)
    step = motion.root_position[0] - end.root_position[-1]
    assert 0.005 < float(step[::2].norm()) < 0.1
    turned = float(heading(motion.local_quat_xyzw[0, 0])) - float(heading(end.local_quat_xyzw[-1, 0]))
    assert abs(math.remainder(turned, 2 * math.pi)) < 0.2


def test_a_clip_warms_up_the_memory():
    clip = walk(40)
    motion = result(0.2, start_clip=clip, settings=replace(RAW, temperature=0.0))
    features, position = encode(clip)
    state = DENSITY.advance(DENSITY.start_after(features[:1].float()), features[None, 1:].float())
    drawn, _ = DENSITY.sample(state, 6, generator(0), temperature=0.0)
    expected = decode(torch.cat([features, drawn[0].double()]), position)
    torch.testing.assert_close(motion.joint_positions(), expected.joint_positions()[40:], atol=1e-5, rtol=0)


class Raised:
    """A refiner that lifts the hips by 10 cm, piece by piece, two frames behind."""

    def refine(self, features):
        return next(self.stream([features]))

    def stream(self, pieces):
        held = None
        for piece in pieces:
            held = piece.clone() if held is None else torch.cat([held, piece], 1)
            held[:, -piece.shape[1] :, LAYOUT.slices["root_height"]] += 0.1
            yield held[:, :-2]
            held = held[:, -2:]


@pytest.mark.slow
def test_a_refiner_comes_before_the_motion_is_decoded():
    plain, lifted = result(), result(refiner=Raised())
    assert lifted.num_frames == plain.num_frames
    torch.testing.assert_close(lifted.root_position[:, 1], plain.root_position[:, 1] + 0.1, atol=1e-5, rtol=0)


def test_starts_of_several_motions_are_spread_by_weight_and_the_first_do_not_depend_on_how_many():
    weight = torch.tensor([0.1, 0.2, 0.3, 0.4])
    prior = replace(DENSITY, initial_states=replace(DENSITY.initial_states, weight=weight))
    drawn = sample_stratified_starts(prior, 200, generator(1))
    counts = torch.bincount(torch.tensor(drawn), minlength=4) / 200
    torch.testing.assert_close(counts, weight, atol=0.015, rtol=0)
    assert sample_stratified_starts(prior, 7, generator(1)) == drawn[:7]
    assert sample_stratified_starts(prior, 7, generator(2)) != drawn[:7]


RATES = {("stand", "walk"): 0.1, ("walk", "stand"): 0.05, ("walk", "run"): 0.15, ("run", "walk"): 0.5}


@dataclass(frozen=True, eq=False)
class Conditioned(ToyDensity):
    """Takes on a pace that conditions it often enough; its frames hold the number of the pace and how often it was."""

    pace: int = 0
    times: int = 0
    needed: int = 1
    sway: float = 0.0
    rates: Mapping[tuple[str, str], float] = field(default_factory=lambda: RATES)

    @property
    def pace_rates(self):
        return self.rates

    def conditioned_on(self, labels):
        (label,) = labels
        return replace(self, pace=["pace=stand", "pace=walk", "pace=run"].index(label) + 1, times=self.times + 1)

    def sample(self, state, frames, generator, *, temperature=1.0):
        features = state.last_frame.expand(1, frames, -1).clone()
        step = LAYOUT.pick(features, "root_displacement_heading")
        if self.times >= self.needed:
            step[..., 1] = [0.0, 0.0, 1.2, 3.0][self.pace] / 30
        step[..., 0] = self.sway / 30 * torch.tensor([1.0, -1.0]).repeat(frames)[:frames]
        features[..., PACE], features[..., TIMES] = self.pace, self.times
        return features, LastFrameState(features[:, -1])

    def sample_planted(self, state, frames, generator, *, temperature=1.0, sigma_speed):
        return self.sample(state, frames, generator, temperature=temperature)


PACE, TIMES = LAYOUT.continuous - 1, LAYOUT.continuous - 2
TOY = toy_density()
PACED = Conditioned(TOY.initial_states, TOY.mean, TOY.sigma)
STANDS = LastFrameState(torch.zeros(1, LAYOUT.size))


def begin(prior=PACED, speed=0.0) -> Beginning:
    """Beginning of a standing character, or one at this speed, m/s."""
    return Beginning(prior, STANDS, GroundPose.origin(torch.float64), speed)


def sample_paced(prior, settings=None, *, speed=0.0, seed=0):
    """Pieces of a motion conditioned on paces, without end."""
    drawn = generator(seed)
    paces = plan_paces(prior, speed, drawn)
    return sample_pieces(begin(prior, speed), drawn, settings, paces=paces)


def sample(prior, pieces, **options):
    """So many pieces, joined."""
    return torch.cat(list(islice(sample_paced(prior, **options), pieces)))


def test_paces_last_as_long_as_the_rates_say():
    drawn = list(islice(draw_paces(RATES, "stand", generator()), 6000))
    assert drawn[0][0] == "stand"
    lasted = {
        pace: torch.tensor([frames / 30 for known, frames in drawn if known == pace])
        for pace in ("stand", "walk", "run")
    }
    for pace, mean in (("stand", 10.0), ("walk", 5.0), ("run", 2.0)):
        assert float(lasted[pace].mean()) == pytest.approx(mean, rel=0.08)
        assert float(lasted[pace].std()) == pytest.approx(mean, rel=0.12)  # an exponential distribution
    changes = Counter((one, other) for (one, _), (other, _) in pairwise(drawn))
    assert set(changes) == set(RATES)
    assert changes["walk", "run"] / changes["walk", "stand"] == pytest.approx(3.0, rel=0.15)


@pytest.mark.slow
def test_each_piece_is_sampled_given_its_pace():
    plan = list(islice(draw_paces(RATES, "stand", generator(5)), 12))
    frames = sum(count for _, count in plan)
    pieces = list(islice(sample_paced(PACED, seed=5), 2000))
    assert max(map(len, pieces)) <= 20
    numbers = {"stand": 1.0, "walk": 2.0, "run": 3.0}
    expected = torch.cat([torch.full((count,), numbers[pace]) for pace, count in plan])
    # Nothing else draws from the generator here, so the plan is the same.
    sampled = torch.cat(pieces)[:frames]
    assert torch.equal(sampled[:, PACE], expected[: len(sampled)])
    assert bool((sampled[:, TIMES] == 1).all())


def test_a_label_not_taken_on_is_guided_harder_and_then_dropped():
    slow = replace(PACED, needed=3, rates={("stand", "walk"): 5.0})
    sampled = sample(slow, 12)
    after = sampled[sampled[:, PACE] == 2]
    assert after[:80:20, TIMES].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert bool((after[60:, TIMES] == 1).all())
    assert float(sample(replace(slow, needed=99), 30)[:, TIMES].max()) == 4
    runs = {("walk", "run"): 5.0}
    ran = sample(replace(slow, needed=99, rates=runs), 30, speed=1.2)
    assert float(ran[ran[:, PACE] == 3, TIMES].max()) == 2, "a run conditioned more often flings its legs"


def test_the_first_pace_is_that_of_the_start():
    for speed, pace in ((0.1, 1), (1.2, 2), (3.0, 3)):
        assert float(sample(PACED, 1, speed=speed)[0, PACE]) == pace
    still = replace(tiny_density(), use_fast=False)
    slow_to_fast = replace(
        still, initial_states=replace(still.initial_states, speed=torch.tensor([0.1, 1.0, 2.0, 3.0]))
    )
    for start, speed in enumerate((0.1, 1.0, 2.0, 3.0)):
        begun = initialise_generation(slow_to_fast, GenerateSettings(start=start), None, generator())
        assert begun.speed == pytest.approx(speed)
    clip = walk(60).pick(torch.tensor([*[0] * 30, *range(60)]))  # stands, and sets off
    step = float(clip.root_position[-31:, [0, 2]].diff(dim=0).mean(0).norm()) * 30
    assert initialise_generation(still, GenerateSettings(), clip, generator()).speed == pytest.approx(step, rel=0.05)


def test_a_density_without_paces_samples_as_in_one_go():
    density = replace(tiny_density(), use_fast=False)
    state = density.initial_states.state.pick(torch.tensor([0]))
    begun = Beginning(density, state, GroundPose.origin(torch.float64), 1.0)
    (piece,) = islice(sample_pieces(begun, generator(4)), 1)
    assert torch.equal(piece, density.sample(state, len(piece), generator(4))[0][0])
