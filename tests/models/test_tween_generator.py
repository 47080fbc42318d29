"""The generator of tweens: sizes, fields, the dense input, and poses that turn with their keys."""

from dataclasses import replace

import pytest
import torch
from helpers import generator, walk

from mapctl import joint_ranges, rotations
from mapctl.inbetweening import PositionImage
from mapctl.kinematics import heading
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.training.windows import interpolate_heading, interpolate_positions
from priors.tweener import INPUT_ROWS, PAPER, GeneratorConfig, GeneratorNetwork, StyleEncoder, regularise_batch

SMALL = GeneratorConfig((8, 8, 8, 12, 12, 12), (12, 12, 8, 8, 8, 8), style=5)


def network(config=SMALL, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        made = GeneratorNetwork(config)
        torch.nn.init.normal_(made.last.weight, std=0.05)
    return made.eval().requires_grad_(False)


def count(module):
    return sum(each.numel() for each in module.parameters())


def image_of(motion, keys, *, present=None, known_axes=None):
    """Whole poses are known at the keys."""
    known = torch.zeros(1, motion.num_frames, 21, dtype=torch.bool)
    known[:, list(keys)] = True
    places, facing = motion.joint_positions().float()[None], heading(motion.local_quat_xyzw[:, 0]).float()[None]
    between = interpolate_positions(places, motion.local_quat_xyzw.float()[None], known)
    return PositionImage.of_world(
        between,
        interpolate_heading(facing, known),
        torch.zeros(1, motion.num_frames, 2),
        known=known,
        present=torch.ones(1, motion.num_frames, dtype=torch.bool) if present is None else present,
        toes=TOE_JOINTS,
        known_axes=known_axes,
    )


def moved(motion, angle, ground):
    turn = rotations.about_y(torch.tensor(angle, dtype=torch.float64)).expand(motion.num_frames, 4)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    root = rotations.rotate(turn, motion.root_position) + torch.tensor([ground[0], 0.0, ground[1]]).double()
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def test_weights_are_as_many_as_may_be_bundled_and_as_in_the_paper():
    """With the path predictor's 0.8 million under 10 MB in float16; in the paper 7.3 + 24.3 + 1.1 million."""
    with torch.device("meta"):
        ours, paper = GeneratorNetwork(), GeneratorNetwork(PAPER)
    assert count(ours) == pytest.approx(4.1e6, rel=0.05)
    assert 2 * (count(ours) + 0.85e6) < 10e6
    assert sum(count(layer.conv) for layer in paper.encoder) == pytest.approx(7.3e6, rel=0.05)
    assert sum(count(layer.conv) for layer in paper.decoder) + count(paper.last) == pytest.approx(24.3e6, rel=0.05)
    assert count(paper.style) == pytest.approx(1.1e6, rel=0.05)
    assert INPUT_ROWS == 133


def test_each_frame_gets_its_nearest_key_and_how_far_that_is():
    motion = walk(40)
    image = image_of(motion, (3, 13, 30))
    copied, away = image.copy_nearest()
    for frame, key in ((0, 3), (3, 3), (8, 3), (9, 13), (21, 13), (22, 30), (39, 30)):
        assert torch.equal(copied[0, frame], image.places[0, key]), frame
        assert bool((away[0, frame] == abs(frame - key)).all())


def test_coordinates_are_known_one_by_one():
    """A drawing of a hand from the front: its depth is told by the key before."""
    motion, hand = walk(30), CANONICAL.index("leftHand")
    axes = torch.zeros(1, 30, 21, 3, dtype=torch.bool)
    axes[0, 20, hand, :2] = True
    image = image_of(motion, (2,), known_axes=axes)
    copied, away = image.copy_nearest()
    assert away[0, 20, hand].tolist() == [0, 0, 18]
    assert torch.equal(copied[0, 25, hand, :2], image.places[0, 20, hand, :2])
    assert torch.equal(copied[0, 25, hand, 2], image.places[0, 2, hand, 2])
    assert not image.known[0, 20].any()
    assert image.mirrored().known_axes[0, 20, CANONICAL.index("rightHand")].tolist() == [True, True, False]


def test_what_is_never_known_is_the_mean_and_far():
    made, image = network(), image_of(walk(30), ())
    made.mean.fill_(3.0)
    rows = made.encode_rows(image)
    assert bool((rows[..., :63] == 0).all())
    assert bool((rows[..., 63:126] == 1).all())
    assert bool(rows.isfinite().all())


@pytest.mark.parametrize("frames", [1, 63, 64, 65, 130])
def test_bodies_of_any_length_are_within_their_ranges(frames):
    image = image_of(walk(130).slice(0, frames), (0,))
    pose = network()(image, torch.randn(1, 5, generator=generator())).pose
    assert pose.places.shape == (1, frames, 21, 3)
    angles = joint_ranges.load().to_angles(pose.local_matrix[..., 1:, :, :])
    assert float(joint_ranges.load().find_excess(angles).max()) < 1e-4


@pytest.mark.parametrize("angle", [0.7, -2.9])
def test_the_answer_turns_with_the_keys_and_stays_where_they_move(angle):
    motion, made, style = walk(100, turn_rate=0.6), network(), torch.zeros(1, 5)
    keys = (0, 40, 99)
    images = [image_of(each, keys) for each in (motion, moved(motion, angle, (30.0, -12.0)))]
    one, other = (made(image, style).turn_to_world(image) for image in images)
    turn = rotations.to_matrix(rotations.about_y(torch.tensor(angle)))
    torch.testing.assert_close(turn @ one.local_matrix[:, :, 0], other.local_matrix[:, :, 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(one.local_matrix[:, :, 1:], other.local_matrix[:, :, 1:], atol=1e-4, rtol=0)
    torch.testing.assert_close(one.places @ turn.T, other.places, atol=1e-4, rtol=0)


def test_the_style_changes_the_answer_and_does_not_depend_on_the_order_of_its_poses():
    made, image = network(), image_of(walk(70), (0, 69))
    encoder = StyleEncoder(5)
    poses = torch.randn(1, 6, 21, 3, generator=generator())
    found = encoder(poses)
    torch.testing.assert_close(found, encoder(poses[:, torch.tensor([3, 1, 5, 0, 2, 4])]))
    hips = poses.clone()
    hips[..., 0, :] += 1.0
    torch.testing.assert_close(found, encoder(hips))
    apart = made(image, found.detach()).pose.places - made(image, -found.detach()).pose.places
    assert float(apart.abs().max()) > 1e-3


def test_batch_regularisation_is_nil_for_unit_responses_and_grows_with_mean_and_spread():
    unit = torch.randn(16, 4, 500, generator=generator())
    unit = (unit - unit.mean(dim=(0, 2), keepdim=True)) / unit.std(dim=(0, 2), keepdim=True, unbiased=False)
    assert float(regularise_batch((unit, unit))) < 1e-6
    assert float(regularise_batch((unit + 0.5,))) == pytest.approx(0.25, rel=1e-3)
    assert float(regularise_batch((unit * 2.0, unit))) == pytest.approx(0.4805, rel=1e-3)
    responses = network().generate(torch.randn(2, INPUT_ROWS, 128, generator=generator()), torch.zeros(2, 5))[1]
    assert len(responses) == 6 + 13
