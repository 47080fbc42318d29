"""Changes of pace of random motion: drawn by the rates of the data, and told to the density piece by piece."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise

import pytest
import torch
from helpers import generator, tiny_density
from toy_density import ToyDensity, toy_density

from controllers.generation.generate import GenerateSettings, generate, sample_pieces
from controllers.generation.pace_plan import draw_paces, plan_paces
from mapctl.features import LAYOUT
from mapctl.protocols import LastFrameState

RATES = {("stand", "walk"): 0.1, ("walk", "stand"): 0.05, ("walk", "run"): 0.15, ("run", "walk"): 0.5}


@dataclass(frozen=True, eq=False)
class Told(ToyDensity):
    """Takes a pace on that it is told often enough; its frames hold the number of the pace and how often it was."""

    pace: int = 0
    times: int = 0
    needed: int = 1
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
        features[..., PACE], features[..., TIMES] = self.pace, self.times
        return features, LastFrameState(features[:, -1])


PACE, TIMES = LAYOUT.continuous - 1, LAYOUT.continuous - 2
TOY = toy_density()
TOLD = Told(TOY.initial_states, TOY.mean, TOY.sigma)
STANDS = LastFrameState(torch.zeros(1, LAYOUT.size))


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


def test_a_pace_that_never_changes_goes_on():
    paces = draw_paces({("stand", "walk"): 1.0, ("walk", "stand"): 0.0}, "stand", generator())
    assert [pace for pace, _ in islice(paces, 4)] == ["stand", "walk", "walk", "walk"]


def test_each_piece_is_sampled_given_its_pace():
    plan = list(islice(draw_paces(RATES, "stand", generator(5)), 12))
    frames = sum(count for _, count in plan)
    pieces = list(islice(sample_pieces(TOLD, STANDS, generator(5), longest=15), 2000))
    assert max(map(len, pieces)) <= 15
    numbers = {"stand": 1.0, "walk": 2.0, "run": 3.0}
    expected = torch.cat([torch.full((count,), numbers[pace]) for pace, count in plan])
    # Nothing else draws from the generator here, so the plan is the same.
    sampled = torch.cat(pieces)[:frames]
    assert torch.equal(sampled[:, PACE], expected[: len(sampled)])
    assert bool((sampled[:, TIMES] == 1).all())


def test_what_is_not_taken_on_is_told_more_emphatically_and_then_no_more():
    slow = replace(TOLD, needed=3, rates={("stand", "walk"): 5.0})
    sampled = torch.cat(list(islice(sample_pieces(slow, STANDS, generator()), 12)))
    after = sampled[sampled[:, PACE] == 2]
    assert after[:80:20, TIMES].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert bool((after[60:, TIMES] == 1).all())
    deaf = replace(slow, needed=99)
    assert float(torch.cat(list(islice(sample_pieces(deaf, STANDS, generator()), 30)))[:, TIMES].max()) == 4


def test_the_first_pace_is_that_of_the_start():
    frame = torch.zeros(1, LAYOUT.size)
    LAYOUT.pick(frame, "root_displacement_heading")[:, 1] = 3.0 / 30
    assert float(next(sample_pieces(TOLD, LastFrameState(frame), generator()))[0, PACE]) == 3


def test_nothing_is_told_where_no_pace_is_known_or_wanted():
    steady = replace(TOLD, rates={})
    assert plan_paces(steady, STANDS, generator()) is None
    assert {float(piece[0, PACE]) for piece in islice(sample_pieces(steady, STANDS, generator()), 3)} == {0.0}
    free = GenerateSettings(condition_on_start=False)
    assert {float(piece[0, PACE]) for piece in islice(sample_pieces(TOLD, STANDS, generator(), free), 3)} == {0.0}


def test_a_density_without_paces_samples_as_in_one_go():
    density = replace(tiny_density(), use_fast=False)
    state = density.initial_states.state.pick(torch.tensor([0]))
    (piece,) = islice(sample_pieces(density, state, generator(4), longest=50), 1)
    assert torch.equal(piece, density.sample(state, 50, generator(4))[0][0])


def test_generated_motion_is_told(monkeypatch):
    density = replace(tiny_density(), use_fast=False)
    asked = []
    monkeypatch.setattr(
        type(density), "pace_rates", property(lambda self: {("walk", "run"): 3.0, ("run", "walk"): 3.0})
    )
    monkeypatch.setattr(type(density), "conditioned_on", lambda self, labels: asked.append(labels) or self)
    settings = GenerateSettings(foot_cleanup=None)
    motion = generate(density, seconds=10.0, generator=generator(), settings=settings).motion
    assert motion.num_frames == 300
    assert {label for labels in asked for label in labels} == {"pace=walk", "pace=run"}
