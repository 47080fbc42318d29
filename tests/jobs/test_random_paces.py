"""Changes of pace of random motion: drawn by the rates of the data, and told to the density piece by piece."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise

import pytest
import torch
from helpers import generator, tiny_density, walk
from toy_density import ToyDensity, toy_density

from controllers.generation.generate import (
    Beginning,
    GenerateSettings,
    draw_paces,
    initialise_generation,
    plan_paces,
    sample_pieces,
)
from mapctl.features import LAYOUT, GroundPose
from mapctl.protocols import LastFrameState

RATES = {("stand", "walk"): 0.1, ("walk", "stand"): 0.05, ("walk", "run"): 0.15, ("run", "walk"): 0.5}


@dataclass(frozen=True, eq=False)
class Told(ToyDensity):
    """Takes a pace on that it is told often enough; its frames hold the number of the pace and how often it was."""

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
TOLD = Told(TOY.initial_states, TOY.mean, TOY.sigma)
STANDS = LastFrameState(torch.zeros(1, LAYOUT.size))


def begin(prior=TOLD, speed=0.0) -> Beginning:
    """Who stands, or goes at this speed, m/s."""
    return Beginning(prior, STANDS, GroundPose.origin(torch.float64), speed)


def sample_told(prior, settings=None, *, speed=0.0, seed=0, **longest):
    """Pieces of a motion that is told paces, without end."""
    drawn = generator(seed)
    paces = plan_paces(prior, speed, drawn)
    return sample_pieces(begin(prior, speed), drawn, settings, paces=paces, **longest)


def sample(prior, pieces, **options):
    """So many pieces, joined."""
    return torch.cat(list(islice(sample_told(prior, **options), pieces)))


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
    pieces = list(islice(sample_told(TOLD, seed=5, longest=15), 2000))
    assert max(map(len, pieces)) <= 15
    numbers = {"stand": 1.0, "walk": 2.0, "run": 3.0}
    expected = torch.cat([torch.full((count,), numbers[pace]) for pace, count in plan])
    # Nothing else draws from the generator here, so the plan is the same.
    sampled = torch.cat(pieces)[:frames]
    assert torch.equal(sampled[:, PACE], expected[: len(sampled)])
    assert bool((sampled[:, TIMES] == 1).all())


def test_what_is_not_taken_on_is_told_more_emphatically_and_then_no_more():
    slow = replace(TOLD, needed=3, rates={("stand", "walk"): 5.0})
    sampled = sample(slow, 12)
    after = sampled[sampled[:, PACE] == 2]
    assert after[:80:20, TIMES].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert bool((after[60:, TIMES] == 1).all())
    assert float(sample(replace(slow, needed=99), 30)[:, TIMES].max()) == 4
    runs = {("walk", "run"): 5.0}
    ran = sample(replace(slow, needed=99, rates=runs), 30, speed=1.2)
    assert float(ran[ran[:, PACE] == 3, TIMES].max()) == 2, "a run that is told more often flings its legs"


def test_the_first_pace_is_that_of_the_start():
    for speed, pace in ((0.1, 1), (1.2, 2), (3.0, 3)):
        assert float(sample(TOLD, 1, speed=speed)[0, PACE]) == pace
    still = replace(tiny_density(), use_fast=False)
    slow_to_fast = replace(
        still, initial_states=replace(still.initial_states, speed=torch.tensor([0.1, 1.0, 2.0, 3.0]))
    )
    for start, speed in enumerate((0.1, 1.0, 2.0, 3.0)):
        begun = initialise_generation(slow_to_fast, GenerateSettings(start=start), None, generator())
        assert begun.speed == pytest.approx(speed)
    clip = walk(60)._map_frames(lambda values: values[[*[0] * 30, *range(60)]])  # stands, and sets off
    step = float(clip.root_position[-31:, [0, 2]].diff(dim=0).mean(0).norm()) * 30
    assert initialise_generation(still, GenerateSettings(), clip, generator()).speed == pytest.approx(step, rel=0.05)


def test_a_density_without_paces_samples_as_in_one_go():
    density = replace(tiny_density(), use_fast=False)
    state = density.initial_states.state.pick(torch.tensor([0]))
    begun = Beginning(density, state, GroundPose.origin(torch.float64), 1.0)
    (piece,) = islice(sample_pieces(begun, generator(4), longest=50), 1)
    assert torch.equal(piece, density.sample(state, 50, generator(4))[0][0])
