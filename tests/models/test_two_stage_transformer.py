"""The two-stage pose transformer: what the first stage looks at, and that the second corrects it."""

from dataclasses import replace

import pytest
import torch
from helpers import corpus
from tiny_transformer import CONFIG, network

from mapctl.inbetweening.partial_motion import KnownParts
from priors.training.recipes.pose_transformer import hide
from priors.training.windows import PoseWindows, add_targets

TWO = replace(CONFIG, detail=2)


def windows(count=3, frames=30):
    drawn = PoseWindows(corpus(2, 80), evenness=0.0).draw(count, frames, torch.Generator().manual_seed(0))
    return add_targets(drawn)


def with_gap(motion, start, stop):
    told = torch.ones(motion.heading.shape, dtype=torch.bool)
    told[:, start:stop] = False
    return replace(motion, known=KnownParts.whole(told))


def test_untrained_both_stages_interpolate_and_what_is_known_stays():
    hidden = with_gap(windows(), 10, 20)
    untrained = network(config=TWO)
    shown = hide(untrained, hidden)
    proposed = untrained(shown)
    places, guess = proposed.poses(hidden.offsets)[0], shown.world_poses()[0]
    torch.testing.assert_close(places, guess, atol=1e-4, rtol=0)
    torch.testing.assert_close(proposed.rough.poses(hidden.offsets)[0], guess, atol=1e-4, rtol=0)
    drawn = network(drawn=0.2, config=TWO)
    made = drawn(hide(drawn, hidden))
    truth = hidden.world_poses()[0]
    torch.testing.assert_close(made.poses(hidden.offsets)[0][:, :10], truth[:, :10], atol=1e-4, rtol=0)
    assert float((made.poses(hidden.offsets)[0] - truth)[:, 10:20].norm(dim=-1).mean()) > 0.02


def with_tilt_alone(motion):
    """Of hips in a gap the tilt is known, and not the heading."""
    hidden = with_gap(motion, 10, 20)
    rotations = hidden.known.rotations.clone()
    rotations[:, 10:20, 0] = True
    return replace(hidden, known=replace(hidden.known, rotations=rotations))


@pytest.mark.parametrize("hide_parts", [lambda motion: with_gap(motion, 10, 20), with_tilt_alone])
def test_the_second_stage_adds_to_what_the_first_proposes(hide_parts):
    hidden = hide_parts(windows())
    # The first stage's head is drawn; the second's is still nil.
    made = network(drawn=0.2, config=TWO)
    proposed = made(hide(made, hidden))
    torch.testing.assert_close(proposed.local_matrix, proposed.rough.local_matrix, atol=1e-5, rtol=0)
    torch.testing.assert_close(proposed.root_position, proposed.rough.root_position)
    torch.nn.init.normal_(made.detail.head.weight, std=0.2)
    corrected = made(hide(made, hidden))
    torch.testing.assert_close(corrected.rough.local_matrix, proposed.rough.local_matrix)
    assert float((corrected.local_matrix - proposed.local_matrix)[:, 10:20].abs().max()) > 0.01
