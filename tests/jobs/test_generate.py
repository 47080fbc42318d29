"""Random generation with an untrained density: lengths, seeds, starts, and pieces that join."""

import math
import sys
from dataclasses import replace

import pytest
import torch
from helpers import bandai_skeleton, generator, tiny_density, turn_between, walk

from controllers.generation.generate import GenerateSettings, generate, sample_stratified_starts, stream
from mapctl import retarget
from mapctl.features import LAYOUT, encode
from mapctl.kinematics import heading
from mapctl.pose import decode
from mapctl.skeleton import CANONICAL

DENSITY = replace(tiny_density(), use_fast=False)
RAW = GenerateSettings(foot_cleanup=None)


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch):
    """Draws are made a piece at a time: the whole piece of 20 s for one second of motion else."""
    monkeypatch.setattr(sys.modules["controllers.generation.generate"], "_CHUNK", 50)


def made(seconds=1.0, *, seed=0, settings=RAW, **wishes):
    return generate(DENSITY, seconds=seconds, generator=generator(seed), settings=settings, **wishes).motion


@pytest.mark.parametrize(("seconds", "frames"), [(0.5, 15), (0.001, 2), (1.51, 45)])
def test_it_is_as_long_as_asked(seconds, frames):
    motion = made(seconds)
    assert (motion.num_frames, motion.fps) == (frames, 30)
    assert motion.skeleton is CANONICAL
    assert bool(torch.isfinite(motion.joint_positions()).all())


@pytest.mark.slow
def test_pieces_join_to_the_motion_sampled_in_one_go(monkeypatch):
    whole = made(2.0, seed=5)
    monkeypatch.setattr(sys.modules["controllers.generation.generate"], "_CHUNK", 13)
    pieces = list(stream(DENSITY, seconds=2.0, generator=generator(5), settings=RAW))
    assert [piece.motion.num_frames for piece in pieces] == [13, 13, 13, 13, 8]
    joined = made(2.0, seed=5)
    torch.testing.assert_close(joined.joint_positions(), whole.joint_positions(), atol=1e-6, rtol=0)
    assert turn_between(joined.local_quat_xyzw, whole.local_quat_xyzw) < 1e-6
    dots = (joined.local_quat_xyzw[1:] * joined.local_quat_xyzw[:-1]).sum(-1)
    assert float(dots.min()) > 0


def test_it_is_what_the_prior_samples_from_the_chosen_start():
    motion = made(0.5, seed=3, settings=replace(RAW, start=2, temperature=0.5))
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
    motion = made(start_clip=clip)
    step = motion.root_position[0] - end.root_position[-1]
    assert 0.005 < float(step[::2].norm()) < 0.1
    turned = float(heading(motion.local_quat_xyzw[0, 0])) - float(heading(end.local_quat_xyzw[-1, 0]))
    assert abs(math.remainder(turned, 2 * math.pi)) < 0.2


def test_a_clip_warms_up_the_memory():
    clip = walk(40)
    motion = made(0.2, start_clip=clip, settings=replace(RAW, temperature=0.0))
    features, place = encode(clip)
    state = DENSITY.advance(DENSITY.start_after(features[:1].float()), features[None, 1:].float())
    drawn, _ = DENSITY.sample(state, 6, generator(0), temperature=0.0)
    expected = decode(torch.cat([features, drawn[0].double()]), place)
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
    plain, lifted = made(), made(refiner=Raised())
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
