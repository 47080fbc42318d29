"""The bench of motion DNA: pairs, how near poses come and how long they stay, of made-up clips."""

import json
from dataclasses import replace

import pytest
import torch
from helpers import run, walk
from tiny_path import save_tiny_path
from tiny_tweener import save_tiny_tweener

from controllers.benchmarks.tweener.dna import (
    StyleClip,
    benchmark_dna,
    choose_examples,
    choose_keys,
    compute_eq_11,
    compute_eq_12,
    lay_keys,
    measure_dwell,
    paste_poses,
    take_bare_poses,
)
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl import motion_dna, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening import Proposal
from mapctl.motion_dna import MotionDna
from mapctl.protocols import Inbetweener

RAW = InfillSettings(finish=False)


def clip_of(content, manner, **told):
    return StyleClip(content, manner, walk(90, **told))


CLIPS = [
    clip_of("slow", "a"),
    clip_of("slow", "b", cadence=1.1),
    clip_of("quick", "a", cadence=1.6, seed=3),
    clip_of("other", "a", cadence=1.3, seed=5),
]


class Shows(Inbetweener):
    """Shows a clip over and over, in any gap."""

    def __init__(self, clip):
        self.clip = clip

    def propose(self, query, *, generator=None):
        at = torch.arange(query.motion.num_frames) % self.clip.num_frames
        made = replace(query.motion, local_quat_xyzw=self.clip.local_quat_xyzw[at])
        return Proposal(made, torch.zeros(len(at), 2), "shows")


def rows_of(make, examples):
    made = benchmark_dna([walk(60)], examples, CLIPS, make, SlerpInbetweener(), seconds=6.0, settings=RAW)
    return {row["by"]: row for row in made}


@pytest.mark.slow
def test_who_shows_what_is_told_wins_all_pairs_and_who_does_not_none():
    examples = choose_examples(CLIPS, 3)
    shown = {id(one.dna): one.motion for one in examples}
    heeding = rows_of(lambda dna: SlerpInbetweener() if dna is None else Shows(shown[id(dna)]), examples)
    assert heeding["DNA"]["pairs_percent"] == 100
    assert heeding["DNA"]["nearer_cm"] > 0.1
    assert heeding["DNA"]["eq_11_cm"] < 0.1 < heeding["no DNA"]["eq_11_cm"]
    assert heeding["poses pasted as keys"]["eq_11_cm"] < 0.1
    assert heeding["mocap of the same content"]["eq_11_cm"] < heeding["mocap of another content"]["eq_11_cm"]
    assert heeding["DNA 40 s apart"]["speed_cm_s"] > 10 > 1 > heeding["no DNA 40 s apart"]["speed_cm_s"]
    assert heeding["DNA 40 s apart"]["spread_cm"] > 2 > heeding["no DNA 40 s apart"]["spread_cm"]
    deaf = rows_of(lambda dna: SlerpInbetweener(), examples)["DNA"]
    assert (deaf["pairs_percent"], deaf["nearer_cm"]) == (0, 0)


def test_eq_12_asks_for_a_pose_in_three_seconds_and_eq_11_for_every_pose():
    bare, dna = take_bare_poses(CLIPS[0].motion), CLIPS[0].dna
    assert compute_eq_11(bare, dna) < 1e-3
    far = MotionDna(torch.cat([dna.poses, dna.poses + torch.tensor([0.0, 1.0, 0.0])]))
    assert compute_eq_11(bare, far) == pytest.approx(50, rel=0.1)
    assert compute_eq_12(bare, far, 6.0) < 1e-3
    assert compute_eq_12(bare[:1].expand(90, -1, -1), far, 6.0) > 1


def test_a_pose_that_flashes_up_stays_for_a_frame():
    pose = walk(90).local_quat_xyzw[:1]
    raised = pose.clone()
    raised[:, 1] = rotations.from_rotation_vector(torch.tensor([1.2, 0.0, 0.0]).double())
    dna = motion_dna.of_rotations(raised, 1)
    for frames in (1, 7):
        quats = torch.cat([pose.expand(30, -1, -1), raised.expand(frames, -1, -1), pose.expand(30, -1, -1)])
        bare = take_bare_poses(replace(walk(60 + frames), local_quat_xyzw=quats))
        assert measure_dwell(bare, dna) == [frames]
    assert measure_dwell(take_bare_poses(replace(walk(9), local_quat_xyzw=raised.expand(9, -1, -1))), dna) == [9]


def test_keys_are_the_ends_and_pasted_poses_lie_evenly_on_the_way():
    plain = lay_keys(walk(60), 6.0)
    assert plain.num_frames == 181
    assert torch.equal(plain.root_position[-1], walk(60).root_position[-1])
    shown, keys = paste_poses(plain, CLIPS[2].motion)
    frames = keys.frames
    assert frames[0] == 0
    assert frames[-1] == 180
    assert len(frames) == len(CLIPS[2].dna.poses) + 2
    ahead = shown.root_position[list(frames), 2]
    assert float(torch.diff(ahead).min()) > 0
    at = torch.tensor(frames[1:-1])
    torch.testing.assert_close(take_bare_poses(shown)[at], CLIPS[2].dna.poses[:, 1:], atol=1e-5, rtol=1e-5)


def test_examples_are_of_different_content_and_keys_of_who_walks_and_who_stands():
    assert [one.content for one in choose_examples(CLIPS, 2)] == ["other", "quick"]
    assert choose_examples(CLIPS, 12)[2] in CLIPS[:2]
    with pytest.raises(RequestError, match="two contents"):
        choose_examples(CLIPS[:2], 5)
    still = StyleClip("wave", "a", replace(walk(50), root_position=walk(50).root_position[:1].expand(50, 3)))
    walking = StyleClip("walk", "a", walk(70))
    assert [motion.num_frames for motion in choose_keys([walking, still])] == [70, 50]
    with pytest.raises(RequestError, match="walks or stands"):
        choose_keys([clip_of("run", "a")])


@pytest.mark.slow
def test_the_command_measures_clips_that_the_card_holds_out(tmp_path, capsys):
    data = tmp_path / "data"
    data.mkdir()
    names = [f"dataset-1_{content}_active_001.bvh" for content in ("walk", "run")]
    for number, name in enumerate(names):
        walk(60, cadence=1 + 0.3 * number).save(data / name)
    predictor = save_tiny_path(tmp_path / "path.safetensors")
    trained = save_tiny_tweener(tmp_path / "t.safetensors", str(predictor), held_out={"validation": names, "test": []})
    words = ["--data", data, "--tweener", trained, "--path", predictor, "--dna", 2, "--raw", "--json"]
    assert run("bench", "tweener", *words) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    named = ["DNA", "no DNA", "poses pasted as keys", "DNA 40 s apart", "no DNA 40 s apart", "mocap of another content"]
    assert [row["by"] for row in rows] == named
