"""Styles by name: classes of clips, their vectors in a card, and what variations draw of them."""

import json

import pytest
import tiny_tweener
import torch
from helpers import corpus, generator

from mapctl.errors import CheckpointError, RequestError
from mapctl.motion_dna import MotionDna
from priors.training.recipes.tweener import collect_dna, compute_classes, group_clips
from priors.tweener import Style, count_clips, encode_classes, find_class, pick_class, read_classes


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


def test_labels_of_one_s_own_are_the_first_group_that_took_part():
    assert find_class("take_angry_walk.bvh", r"_([a-z]+)_") == "angry"
    assert find_class("take_angry_walk.bvh", r"(run)|(walk)") == "walk"
    assert find_class("take.bvh", r"_([a-z]+)_") is None
    with pytest.raises(RequestError, match="must be a regular expression"):
        find_class("take.bvh", "(")
    with pytest.raises(RequestError, match="needs a group"):
        find_class("take.bvh", "take")
    with pytest.raises(RequestError, match=r"matches no clip, such as 'a\.bvh'"):
        group_clips(["a.bvh"], "(z)")
    assert group_clips(["003.bvh"]) == {}


def test_vectors_are_means_over_clips_and_come_back_from_the_card():
    encoder, made = tiny_tweener.network().style, corpus(3, 90)
    members = collect_dna(made, r"walk-([01])")
    assert {name: len(each) for name, each in members.items()} == {"0": 1, "1": 1}
    other = MotionDna(torch.randn(4, 21, 3, generator=generator()))
    two = {"both": [members["0"][0], other], "one": members["0"]}
    data = encode_classes(encoder, two)
    card = tiny_tweener.card()
    card.data.update(json.loads(json.dumps(data)))
    classes = read_classes(card, 5)
    each = [encoder(dna.poses[None])[0] for dna in two["both"]]
    assert float((each[0] - each[1]).abs().max()) > 0.1
    torch.testing.assert_close(classes["both"].vector, (each[0] + each[1]) / 2, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(classes["one"].vector, each[0], atol=2e-3, rtol=2e-3)
    assert count_clips(card.data)["classes"] == {"both": 2, "one": 1}
    assert compute_classes(tiny_tweener.network(), made)["classes"]["walk"]["clips"] == 3


@pytest.mark.parametrize("vector", ["%%%", "AAAA", None, "AHwAfAB8AHwAfA=="])
def test_a_broken_class_is_refused(vector):
    card = tiny_tweener.card()
    card.data["classes"] = {"walk": {"clips": 1, "vector": vector}}
    with pytest.raises(CheckpointError, match="the class walk in the card"):
        read_classes(card, 5)


def test_an_unknown_class_is_told_with_the_nearest():
    known = {name: Style(name, torch.zeros(5)) for name in ("wave-left-hand", "walk", "run")}
    assert pick_class(known, "run").name == "run"
    with pytest.raises(RequestError, match="no class wavelefthand; the nearest class is wave-left-hand"):
        pick_class(known, "wavelefthand")
    with pytest.raises(RequestError, match="know no classes"):
        pick_class({}, "walk")
