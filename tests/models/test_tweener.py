"""The tweener: exact keys, hips that go by the body, styles, gaps beyond what its network sees, and the network."""

import json
from dataclasses import replace

import pytest
import tiny_tweener as tiny
import torch
from helpers import corpus, generator, walk
from tiny_path import ToldPath, save_tiny_path
from tiny_tweener import save_tiny_tweener, tiny_tweener

import priors
from controllers.inbetweening.pipeline import CanonicalClip
from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener
from mapctl import joint_ranges, motion_dna
from mapctl.errors import CheckpointError, RequestError
from mapctl.inbetweening import PositionImage
from mapctl.kinematics import heading
from mapctl.numerics.intervals import fill_missing_angle
from mapctl.recording.masks import ALL, Mask, MissingMask
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors.training.recipes.tweener import collect_dna
from priors.tweener import (
    INPUT_ROWS,
    PAPER,
    POSE_ROWS,
    GeneratorConfig,
    GeneratorNetwork,
    Style,
    StyleEncoder,
    constrain_poses,
    count_clips,
    encode_classes,
    find_class,
    find_splits,
    mix_styles,
    pick_class,
    place_poses,
    read_classes,
    regularise_batch,
)


def query_of(motion, *gaps):
    masks = [Mask(ALL, start, stop) for start, stop in gaps]
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


def standing(frames):
    motion = walk(frames)
    return replace(
        motion,
        root_position=motion.root_position[:1].expand(frames, 3).clone(),
        local_quat_xyzw=motion.local_quat_xyzw[:1].expand(frames, 21, 4).clone(),
    )


def test_keys_stay_to_the_bit_and_are_approached_smoothly():
    query = query_of(walk(120), (1, 60), (61, 119))
    known, shown = ~query.missing.frames, query.motion
    result = tiny_tweener().propose(query).motion
    assert torch.equal(result.root_position[known], shown.root_position[known])
    same = (result.local_quat_xyzw * shown.local_quat_xyzw).sum(dim=-1).abs()
    assert float((1 - same[known]).max()) < 1e-12
    positions = result.joint_positions() - result.root_position[:, None]
    step = torch.diff(positions, dim=0).norm(dim=-1).mean(dim=-1)
    beside = step[[0, 59, 60, 118]]
    assert float(beside.max()) < 3 * float(step.median())


@pytest.mark.slow
def test_hips_that_tremble_are_led_calmly():
    motion = walk(100)
    shaken = replace(motion, root_position=motion.root_position + 0.01 * (-1.0) ** torch.arange(100)[:, None])
    query = query_of(motion, (1, 99))
    calm, trembling = (
        torch.diff(tiny_tweener(path=ToldPath(given)).propose(query).motion.root_position, n=3, dim=0)[10:-10].norm()
        for given in (motion, shaken)
    )
    given = torch.diff(shaken.root_position, n=3, dim=0)[10:-10].norm()
    assert float(trembling) < 0.4 * float(given)
    assert float(calm) < float(trembling)


def test_hips_go_where_the_path_predictor_sees_them_go_and_arrive():
    motion = walk(100)
    query = query_of(motion, (1, 99))
    for stretch in (1.0, 1.3):
        result = tiny_tweener(path=ToldPath(motion, stretch)).propose(query).motion
        away = (result.root_position - motion.root_position)[:, ::2].norm(dim=-1)
        assert float(away.max()) < 0.1  # the made body faces elsewhere than the walk's
        steps = torch.diff(result.root_position[:, 2])
        assert float(steps.min()) > 0


def test_it_goes_with_the_path_predictor_that_it_was_trained_with(tmp_path):
    predictor = str(save_tiny_path(tmp_path / "path.safetensors"))
    saved = str(save_tiny_tweener(tmp_path / "tweener.safetensors", predictor))
    assert priors.load_tweener(saved, predictor).name == saved
    assert priors.load_inbetweener(saved, predictor).card.kind == "tweener"
    with pytest.raises(CheckpointError, match="trained with the path predictor"):
        priors.load_tweener(saved, "path")


FAST = motion_dna.of(walk(90, cadence=1.4, seed=5))


def furthest(one, other):
    """How far rotations of two motions are apart, the most of all joints, by frame."""
    return (one.local_quat_xyzw - other.local_quat_xyzw).abs().amax(dim=(1, 2))


def test_a_style_changes_the_generated_frames_and_keeps_the_keys():
    query, plain = query_of(walk(120), (1, 119)), tiny_tweener()
    styled = plain.styled(FAST)
    assert (plain.has_style, styled.has_style) == (False, True)
    one, other = (each.propose(query) for each in (plain, styled))
    assert (one.source, other.source) == ("tweener", "tweener in the style of motion DNA")
    apart = furthest(one.motion, other.motion)
    assert float(apart[30:90].max()) > 1e-3
    assert float(apart[[0, 119]].max()) == 0


def test_a_class_of_the_card_is_a_style_without_poses():
    card = tiny.card(classes=("walk", "dance-on"))
    classes = read_classes(card, tiny.CONFIG.style)
    assert set(classes) == {"walk", "dance-on"}
    plain, query = tiny_tweener(), query_of(walk(120), (1, 119))
    result = [plain.in_style(style).propose(query).motion for style in classes.values()]
    assert float(furthest(*result)[30:90].max()) > 1e-4
    assert all(style.poses is None for style in classes.values())


@pytest.mark.slow
def test_a_long_gap_is_split_by_poses_of_the_style_or_of_the_keys_with_a_note():
    query, plain = query_of(walk(600), (10, 580)), tiny_tweener()
    result = {}
    for tweener, by in ((plain, "the keys beside it"), (plain.styled(FAST), "the style")):
        answer = tweener.propose(query)
        (source,) = answer.attribute(query)
        assert (source.start, source.stop) == (10, 580)
        assert source.reason == f"longer than the 16 s that the tweener sees; split at 6.7, 13.0 s by poses of {by}"
        result[by] = answer.motion
    nothing = replace(plain, style=Style("nothing", plain.encode_style(FAST).vector))
    assert float(furthest(result["the style"], nothing.propose(query).motion)[150:450].max()) > 1e-3
    short = query_of(walk(120), (10, 100))
    assert not plain.propose(short).attribute(short)[0].reason


@pytest.mark.slow
def test_poses_that_split_a_gap_stand_on_the_way_and_face_along_it():
    query = query_of(walk(1100, turn_rate=0.05), (1, 1099))
    (frames,) = find_splits(query).values()
    assert frames == [221, 440, 660, 879]
    body = query.to_unit_size(query.motion)
    placed = place_poses(FAST, body, frames)
    assert float((placed[:, 0] - body.root_position[frames])[:, ::2].abs().max()) < 1e-6
    torch.testing.assert_close(placed[:, list(TOE_JOINTS), 1].amin(dim=1), torch.full((4,), TOE_REST_HEIGHT).double())
    across = (placed[:, 13] - placed[:, 17])[:, ::2]  # from the right upper leg to the left
    own = FAST[[number * len(FAST) // 4 for number in range(4)]]
    first = (own[:, 13] - own[:, 17])[:, ::2]
    turned = torch.atan2(across[:, 0], across[:, 1]) - torch.atan2(first[:, 0], first[:, 1])
    off = turned - heading(body.local_quat_xyzw[frames, 0])
    assert float(torch.sin(off / 2).abs().max()) < 1e-4


@pytest.mark.slow
def test_auto_gives_the_tweener_what_has_room_for_a_style_and_holds_nobody():
    query = query_of(walk(200), (1, 30), (31, 100), (101, 199))
    styled = AutoInbetweener(SlerpInbetweener(), tweener=tiny_tweener().styled(FAST))
    assert styled.has_style
    sources = styled.propose(query).attribute(query)
    name = "tweener in the style of motion DNA"
    assert [source.by for source in sources] == ["slerp", name, name]
    assert sources[0].reason == "too short, or with partial keys, for a style"
    plain = AutoInbetweener(SlerpInbetweener(), tweener=tiny_tweener()).propose(query).attribute(query)
    assert {source.by for source in plain} == {"slerp"}
    still = query_of(standing(200), (1, 199))
    assert [source.by for source in styled.propose(still).attribute(still)] == [name]


def test_several_styles_are_mixed():
    tweener = tiny_tweener()
    one, other = tweener.encode_style(FAST, "one"), Style("other", torch.ones(5))
    mixed = mix_styles([one, other])
    assert mixed.name == "one and other"
    torch.testing.assert_close(mixed.vector, (one.vector + 1) / 2)
    assert mixed.poses is not None
    assert len(mixed.poses) == len(FAST)
    assert mix_styles([other]).poses is None
    both = torch.cat([FAST, FAST.flip(0)])
    torch.testing.assert_close(tweener.encode_style(both).vector, one.vector)


@pytest.mark.parametrize(
    ("clip", "name"),
    [
        ("bandai-namco-2/data/dataset-2_wave-left-hand_active_015.bvh", "wave-left-hand"),
        ("dataset-1_walk_feminine_001.bvh", "walk"),
        ("cmu/01/01_01.bvh", "cmu-01"),
        ("dance/salsa_03.bvh", "dance"),
        ("a/b/c/x.bvh", "b-c"),
        ("jump_03.bvh", "jump"),
        ("003.bvh", None),
    ],
)
def test_the_class_of_a_clip_is_in_its_name(clip, name):
    assert find_class(clip) == name


def test_vectors_are_means_over_clips_and_come_back_from_the_card():
    encoder, result = tiny.network().style, corpus(3, 90)
    members = collect_dna(result, r"walk-([01])")
    assert {name: len(each) for name, each in members.items()} == {"0": 1, "1": 1}
    other = torch.randn(4, 21, 3, generator=generator())
    two = {"both": [members["0"][0], other], "one": members["0"]}
    data = encode_classes(encoder, two)
    card = tiny.card()
    card.data.update(json.loads(json.dumps(data)))
    classes = read_classes(card, 5)
    each = [encoder(dna[None])[0] for dna in two["both"]]
    assert float((each[0] - each[1]).abs().max()) > 0.1
    torch.testing.assert_close(classes["both"].vector, (each[0] + each[1]) / 2, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(classes["one"].vector, each[0], atol=2e-3, rtol=2e-3)
    assert count_clips(card.data)["classes"] == {"both": 2, "one": 1}
    assert encode_classes(encoder, collect_dna(result))["classes"]["walk"]["clips"] == 3


@pytest.mark.parametrize("vector", ["%%%", "AAAA", "AHwAfAB8AHwAfA=="])
def test_a_broken_class_is_refused(vector):
    card = tiny.card()
    card.data["classes"] = {"walk": {"clips": 1, "vector": vector}}
    with pytest.raises(CheckpointError, match="the class walk in the card"):
        read_classes(card, 5)


def test_an_unknown_class_is_refused_with_the_nearest():
    known = {name: Style(name, torch.zeros(5)) for name in ("wave-left-hand", "walk", "run")}
    assert pick_class(known, "run").name == "run"
    with pytest.raises(RequestError, match="no class wavelefthand; the nearest class is wave-left-hand"):
        pick_class(known, "wavelefthand")
    with pytest.raises(RequestError, match="know no classes"):
        pick_class({}, "walk")


def count(module):
    return sum(each.numel() for each in module.parameters())


def image_of(motion, keys, *, known_axes=None):
    """Whole poses are known at the keys."""
    known = torch.zeros(1, motion.num_frames, 21, dtype=torch.bool)
    known[:, list(keys)] = True
    positions, facing = motion.joint_positions().float()[None], heading(motion.local_quat_xyzw[:, 0]).float()[None]
    return PositionImage.of_world(
        positions,
        fill_missing_angle(facing, known[..., 0]),
        torch.zeros(1, motion.num_frames, 2),
        known=known,
        known_axes=known_axes,
    )


def test_weights_are_as_many_as_may_be_bundled_and_as_in_the_paper():
    """With the path predictor's 0.8 million under 10 MB in float16; in the paper 7.3 + 24.3 + 1.1 million."""
    with torch.device("meta"):
        ours, paper = GeneratorNetwork(GeneratorConfig()), GeneratorNetwork(PAPER)
    assert count(ours) == pytest.approx(4.1e6, rel=0.05)
    assert 2 * (count(ours) + 0.85e6) < 10e6
    assert sum(count(layer.conv) for layer in paper.encoder) == pytest.approx(7.3e6, rel=0.05)
    assert sum(count(layer.conv) for layer in paper.decoder) + count(paper.last) == pytest.approx(24.3e6, rel=0.05)
    assert count(paper.style) == pytest.approx(1.1e6, rel=0.05)
    assert INPUT_ROWS == 133


def test_the_style_changes_the_answer_and_does_not_depend_on_the_order_of_its_poses():
    result, image = tiny.network(), image_of(walk(70), (0, 69))
    encoder = StyleEncoder(5)
    poses = torch.randn(1, 6, 21, 3, generator=generator())
    found = encoder(poses)
    torch.testing.assert_close(found, encoder(poses[:, torch.tensor([3, 1, 5, 0, 2, 4])]))
    hips = poses.clone()
    hips[..., 0, :] += 1.0
    torch.testing.assert_close(found, encoder(hips))
    apart = result(image, found.detach()).pose.positions - result(image, -found.detach()).pose.positions
    assert float(apart.abs().max()) > 1e-3


def test_batch_regularisation_is_nil_for_unit_responses_and_grows_with_mean_and_spread():
    unit = torch.randn(16, 4, 500, generator=generator())
    unit = (unit - unit.mean(dim=(0, 2), keepdim=True)) / unit.std(dim=(0, 2), keepdim=True, unbiased=False)
    assert float(regularise_batch((unit, unit))) < 1e-6
    assert float(regularise_batch((unit + 0.5,))) == pytest.approx(0.25, rel=1e-3)
    assert float(regularise_batch((unit * 2.0, unit))) == pytest.approx(0.4805, rel=1e-3)
    responses = tiny.network().generate(torch.randn(2, INPUT_ROWS, 128, generator=generator()), torch.zeros(2, 5))[1]
    assert len(responses) == 6 + 13


def test_coordinates_are_known_one_by_one():
    """A drawing of a hand from the front: its depth is that of the key before."""
    motion, hand = walk(30), CANONICAL.index("leftHand")
    axes = torch.zeros(1, 30, 21, 3, dtype=torch.bool)
    axes[0, 20, hand, :2] = True
    image = image_of(motion, (2,), known_axes=axes)
    copied, away = image.copy_nearest()
    assert away[0, 20, hand].tolist() == [0, 0, 18]
    assert torch.equal(copied[0, 25, hand, :2], image.positions[0, 20, hand, :2])
    assert torch.equal(copied[0, 25, hand, 2], image.positions[0, 2, hand, 2])
    assert not image.known[0, 20].any()
    assert image.mirrored().known_axes[0, 20, CANONICAL.index("rightHand")].tolist() == [True, True, False]


def rows(*shape, spread=1.0, seed=0):
    return spread * torch.randn(*shape, POSE_ROWS, generator=generator(seed), dtype=torch.float64)


@pytest.mark.parametrize("spread", [0.1, 1.0, 50.0])
def test_whatever_goes_in_a_body_within_its_ranges_comes_out(spread):
    pose = constrain_poses(rows(2, 7, spread=spread))
    angles = joint_ranges.load().to_angles(pose.local_matrix[..., 1:, :, :])
    assert float(joint_ranges.load().find_excess(angles).max()) < 1e-5
    unit = pose.local_matrix.mT @ pose.local_matrix
    torch.testing.assert_close(unit, torch.eye(3).double().expand_as(unit), atol=1e-5, rtol=0)
    lengths = (pose.positions[..., 1:, :] - pose.positions[..., list(CANONICAL.parents[1:]), :]).norm(dim=-1)
    torch.testing.assert_close(lengths, CANONICAL.offsets[1:].norm(dim=-1).expand_as(lengths), atol=1e-6, rtol=0)
