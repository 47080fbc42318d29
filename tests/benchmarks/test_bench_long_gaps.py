"""The bench of long gaps: ratios of sums beside mocap, of clips that are long enough."""

import json
import math
from dataclasses import dataclass, replace

import pytest
import torch
from helpers import run, walk
from tiny_path import save_tiny_path
from tiny_tweener import card, network

from controllers.benchmarks.tweener.gap_measures import GapSums, Method, measure_key_jerk
from controllers.benchmarks.tweener.long_gaps import benchmark_long_gaps, cut_middle
from controllers.inbetweening.pipeline import InfillSettings
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.metrics.liveliness import Liveliness
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from priors import checkpoints
from priors.checkpoints import compute_hash

RAW = InfillSettings(finish=False)


@dataclass(frozen=True, eq=False)
class Told(Inbetweener):
    """Answers with a motion, or with its frames from the middle away from it at half the pace."""

    truth: Motion
    slow: bool = False

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        frame = torch.arange(query.motion.num_frames)
        quats = self.truth.local_quat_xyzw[frame // 2 if self.slow else frame]
        made = replace(query.motion, root_position=self.truth.root_position, local_quat_xyzw=quats)
        return Proposal(made, estimate_contact_logits(made), "told")


@pytest.mark.slow
def test_who_knows_the_motion_is_as_alive_as_mocap_and_slerp_is_not():
    motion = walk(110)
    methods = [Method("told", Told(motion), RAW), Method("slow", Told(motion, slow=True), RAW)]
    slerp, told, slow = benchmark_long_gaps({"walks": [motion]}, methods, frames=108)
    assert [row["by"] for row in (slerp, told, slow)] == ["slerp", "told", "slow"]
    assert told["error_cm"] < 0.1
    assert told["hips_cm"] < 0.1
    assert all(told[name] == pytest.approx(1, abs=0.01) for name in ("speed", "spread", "planted"))
    assert told["jerk"] == pytest.approx(1, abs=0.05)
    assert slerp["speed"] < 0.2
    assert slerp["error_cm"] > 2
    assert 0.4 < slow["speed"] < 0.75
    assert slow["jerk"] > slerp["jerk"]
    assert told["key_jerk"] < 1.5


def test_a_body_that_twitches_beside_a_key_is_told():
    motion = walk(60)
    own = measure_key_jerk(motion, motion)
    assert 0.05 < own < 1.5
    for frame, least in ((2, 2), (57, 2), (30, 0)):
        root = motion.root_position.clone()
        root[frame] += 0.05
        found = measure_key_jerk(replace(motion, root_position=root), motion)
        assert found > least * own if least else found == own


def test_gaps_lie_in_the_middle_and_shorter_clips_are_taken_whole():
    motion = walk(100)
    part = cut_middle(motion, 50)
    assert part is not None
    assert part.num_frames == 52
    assert torch.equal(part.root_position[0], motion.root_position[24])
    whole = cut_middle(motion, 140)
    assert whole is not None
    assert whole.num_frames == 100
    assert cut_middle(motion, 200) is None


@pytest.mark.slow
def test_the_command_compares_in_betweeners_on_held_out_clips(tmp_path, capsys):
    data = tmp_path / "data"
    (data / "bandai").mkdir(parents=True)
    walk(70).save(data / "bandai" / "a_walk_1.bvh")
    predictor = str(save_tiny_path(tmp_path / "path.safetensors"))
    held = {"path": compute_hash(predictor), "held_out": {"validation": ["bandai/a_walk_1.bvh"], "test": []}}
    saved = tmp_path / "tweener.safetensors"
    checkpoints.save(network().state_dict(), replace(card(), data=held), saved)
    words = ["--part", "gaps", "--tweener", saved, "--path", predictor, "--seconds", "1,2", "--raw", "--json"]
    assert run("bench", "tweener", "--data", data, *words) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["seconds"], row["by"]) for row in rows] == [
        (seconds, by) for seconds in (1, 2) for by in ("slerp", str(saved))
    ]
    assert run("bench", "tweener", "--data", data, *words[:6], "--seconds", "long") == 2
    assert "--seconds takes numbers" in capsys.readouterr().err


def test_jerk_at_keys_is_not_that_of_frames_inside_a_gap():
    """Third differences reach over four frames: of the first and the last four of a gap no known one is among them."""
    motion, gap = walk(60), (10, 50)
    for frame, at_keys in ((13, False), (46, False), (12, True), (47, True)):
        root = motion.root_position.clone()
        root[frame] += 0.5
        found = measure_key_jerk(replace(motion, root_position=root), motion, gap)
        assert (found != measure_key_jerk(motion, motion, gap)) == at_keys


def test_toes_that_never_touch_the_floor_have_no_speed_there():
    some = Liveliness(1.0, 1.0, 1.0, 1.0, 1.0)
    summed = GapSums(made=some, true=some, clips=1, frames=1)
    assert math.isnan(summed.summarise()["planted_cm_s"])
    assert math.isnan(summed.summarise()["mocap_cm_s"])
