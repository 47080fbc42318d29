"""The bench of keys: what it measures of who misses keys by so much, of made seconds beside mocap's, and of time."""

import json
import time
from dataclasses import dataclass, replace

import pytest
import tiny_infiller
import torch
from helpers import run, walk, walks
from test_bench_long_gaps import Told
from tiny_path import save_tiny_path, tiny_path
from tiny_tweener import card, network

from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.gaps_with_past import Setting, benchmark_gaps_with_past, cut_gaps
from controllers.benchmarks.tweener.processing_time import Stopwatch, TimedPath, benchmark_processing_time
from controllers.benchmarks.tweener.spliced_keys import KeySequence, benchmark_spliced_keys
from controllers.benchmarks.tweener.told_apart import benchmark_told_apart, find_spliced_gaps
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl.commands.bench.tweener.sequences import LONG_GAPS, SINGLE_KEYS, HeldOutClips
from mapctl.errors import RequestError
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.root_trajectory import LocalMotion
from mapctl.metrics.realism import ClassifierSettings, RealismSettings
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from priors import checkpoints
from priors.checkpoints import compute_hash

RAW = InfillSettings(finish=False)
QUICK = RealismSettings(classifier=ClassifierSettings(steps=60, width=8, batch=32), dims=8)


def keyed(motion: Motion, frames: list[int], clips: list[int]) -> KeySequence:
    """A motion of which these frames are keys, of these clips."""
    known, clip = torch.zeros(motion.num_frames, dtype=torch.bool), torch.zeros(motion.num_frames, dtype=torch.long)
    known[frames] = True
    clip[frames] = torch.tensor(clips)
    return KeySequence(motion, known, torch.ones_like(known), clip)


def shifted(motion: Motion, shift: torch.Tensor, joint: int | None = None):
    """Raw proposals of who knows the motion but for this shift by frame (metres), of all joints or one."""

    def propose_raw(query: GapQuery) -> torch.Tensor:
        places = motion.joint_positions().clone()
        if joint is None:
            return places + shift[:, None]
        places[:, joint] += shift
        return places

    return propose_raw


@pytest.mark.slow
def test_keys_are_missed_in_joints_and_in_the_hips_by_what_they_are_missed():
    motion = walk(60)
    sequence, slerp = keyed(motion, [0, 20, 40], [0, 0, 0]), SlerpInbetweener()
    drift = torch.zeros(60, 3).double()
    drift[:, 0] = 0.01 * torch.arange(60)  # a centimetre a frame
    still = drift * 0 + torch.tensor([0.0, 0.0, 0.2])
    methods = [
        Method("drifts", slerp, raw=shifted(motion, drift)),
        Method("elsewhere", slerp, raw=shifted(motion, still)),
        Method("a hand", slerp, raw=shifted(motion, still, joint=8)),
        Method("meets them", slerp),
    ]
    drifts, elsewhere, hand = benchmark_spliced_keys([sequence, sequence], methods, count=2)
    assert (drifts["sequences"], drifts["keys"]) == (2, 6)
    assert drifts["joints_cm"] == pytest.approx(0, abs=1e-9)
    assert drifts["hips_cm"] == pytest.approx((20 + 0 + 20) / 3)
    assert drifts["hips_from_first_cm"] == pytest.approx((0 + 20 + 40) / 3)
    assert drifts["hips_between_cm"] == pytest.approx(20)
    assert elsewhere["hips_cm"] == pytest.approx(0, abs=1e-9)
    assert hand["joints_cm"] == pytest.approx(20 / 20)
    assert all(row["exact_cm"] == 0 for row in (drifts, elsewhere, hand))


def test_gaps_with_a_past_are_measured_from_the_last_frame_before_them():
    motion = walk(110, turn_rate=0.3)
    assert [part.num_frames for part in cut_gaps(motion, 30)] == [52, 52]
    part = cut_gaps(motion, 30)[0]
    away = torch.full((52, 3), 0.3).double()
    away[-2:, 0] += 0.05
    methods = [Method("told", Told(part), RAW, raw=shifted(part, away)), Method("still", Told(part), RAW)]
    settings = [Setting("short", 30, ("walks",)), Setting("long", 200)]
    slerp, told, silent = benchmark_gaps_with_past({"walks": [part], "runs": [part]}, methods, settings=settings)
    assert [(row["setting"], row["gaps"], row["by"]) for row in (slerp, told, silent)] == [
        ("short", 1, by) for by in ("slerp", "told", "still")
    ]
    assert told["key_hips_cm"] == pytest.approx(5)
    assert told["key_joints_cm"] == pytest.approx(0, abs=1e-6)
    assert silent["key_joints_cm"] is None
    assert told["last_cm"] < 0.1 < slerp["last_cm"] < slerp["error_cm"]
    assert told["error_cm"] < 0.1


@pytest.mark.slow
def test_who_moves_as_mocap_is_taken_for_it_and_interpolation_is_not():
    motion = walk(1001, turn_rate=0.2)
    clips = [motion.slice(first, first + 100) for first in range(0, 1001 - 100, 100)]
    sequence = keyed(motion, list(range(0, 1000, 100)), list(range(10)))
    assert find_spliced_gaps(sequence) == [(first + 1, first + 100) for first in range(0, 900, 100)]
    methods = [Method("slerp", SlerpInbetweener(), RAW), Method("told", Told(motion), RAW)]
    mocap, slerp, told = benchmark_told_apart([sequence], clips, methods, settings=QUICK)
    assert [row["by"] for row in (mocap, slerp, told)] == ["mocap", "slerp", "told"]
    assert slerp["told_apart"] > 0.9
    assert told["told_apart"] < 0.75
    assert slerp["preferred"] < 0.1
    assert told["preferred"] > slerp["preferred"] + 0.15
    assert slerp["frechet"] > 3 * told["frechet"]
    assert slerp["windows"] == told["windows"] == 9 * 7
    alone = keyed(motion, list(range(0, 1000, 100)), [0, 1] * 5)
    with pytest.raises(RequestError, match=r"9 gaps and 2 clips .*; ask for more --sequences"):
        benchmark_told_apart([alone], clips, methods, settings=QUICK)


def test_gaps_are_judged_between_keys_of_different_clips_alone():
    held = HeldOutClips({"walks": [walk(60, seed=number) for number in range(4)]})
    sequences = list(held.draw(4, 700, LONG_GAPS, seed=0))
    spliced = [(each, gap) for each in sequences for gap in find_spliced_gaps(each)]
    assert spliced
    assert all(90 <= stop - start <= 480 for _, (start, stop) in spliced)
    assert all(each.clip[start - 1] != each.clip[stop] for each, (start, stop) in spliced)
    assert len(spliced) < sum(len(each.gaps()) for each in sequences)  # some lie within a clip


def test_sequences_are_of_single_poses_of_clips_that_are_where_their_keys_say():
    held = HeldOutClips({"walks": [walk(100), walk(90, turn_rate=0.3)], "short": [walk(20)]})
    one, other = (list(held.draw(3, 300, SINGLE_KEYS, seed=seed)) for seed in (1, 1))
    assert all(torch.equal(a.motion.root_position, b.motion.root_position) for a, b in zip(one, other, strict=True))
    for sequence in one:
        keys = sequence.known.nonzero()[:, 0]
        assert not bool((sequence.known[1:] & sequence.known[:-1]).any())
        assert len(keys) > 1
        assert set(sequence.clip[keys].tolist()) <= {0, 1}
    with pytest.raises(RequestError, match="no clip that was kept"):
        HeldOutClips({"short": [walk(20)]})


@pytest.mark.slow
def test_time_is_told_by_part():
    sequence, motion = keyed(walk(60), [0, 20, 59], [0, 0, 0]), walk(60)

    @dataclass(frozen=True, eq=False)
    class Slow(Inbetweener):
        stopwatch: Stopwatch

        def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
            with self.stopwatch.measure("poses"):
                until = time.process_time() + 0.02
                while time.process_time() < until:
                    pass
            facing = torch.zeros(1, 4)
            TimedPath(tiny_path(), self.stopwatch).predict(LocalMotion.of_world(torch.zeros(1, 4, 21, 3), facing))
            return Told(motion).propose(query)

    (row,) = benchmark_processing_time([sequence], Slow, finish=False, repeats=3)
    assert (row["frames"], row["keys"]) == (60, 3)
    assert 0.02 <= row["poses_s"] < row["without_map_s"]
    assert row["path_s"] > 0
    assert "map_s" not in row
    (finished,) = benchmark_processing_time([sequence], Slow, repeats=1)
    assert finished["map_s"] > 0


def write_bench_data(folder, count=9):
    """Walks, and a tiny tweener whose card holds them out; words for the bench, it and a tiny recurrent network."""
    (folder / "data" / "bandai").mkdir(parents=True)
    names = [f"bandai/a_walk_{number}.bvh" for number in range(count)]
    for name, motion in zip(names, walks(count, 110), strict=True):
        motion.save(folder / "data" / name)
    predictor = str(save_tiny_path(folder / "path.safetensors"))
    held = {"path": compute_hash(predictor), "held_out": {"validation": names, "test": []}}
    saved = folder / "tweener.safetensors"
    checkpoints.save(network().state_dict(), replace(card(), data=held), saved)
    shape = replace(tiny_infiller.CONFIG, architecture="recurrent")
    recurrent = tiny_infiller.save_tiny_infiller(folder / "rtn.safetensors", drawn=0.05, config=shape)
    words = ("--data", folder / "data", "--tweener", saved, "--path", predictor, "--baselines", recurrent)
    return words, str(saved), str(recurrent)


@pytest.mark.slow
def test_the_command_measures_the_parts_that_are_asked_for(tmp_path, capsys):
    words, tweener, recurrent = write_bench_data(tmp_path, count=2)
    small = ("--count", 10, "--sequences", 2, "--frames", 200, "--raw")
    assert run("bench", "tweener", *words, *small, "--part", "keys", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["part"], row["by"]) for row in rows] == [
        ("keys", tweener),
        ("keys", recurrent),
        *(("gaps with a past", by) for by in ("slerp", tweener, recurrent)),
    ]
    assert all(row["joints_cm"] > 0.1 and row["exact_cm"] < 1e-6 for row in rows[:2])
    assert all(row["key_joints_cm"] > 0.1 for row in rows[3:5])
    assert run("bench", "tweener", *words, *small, "--part", "apart") == 2
    assert "ask for more --sequences" in capsys.readouterr().err
    assert run("bench", "tweener", *words, "--part", "keys,price") == 2
    assert (
        "--part takes path, gaps, spectrum, keys, partial, apart, dna, speed or all; got price"
        in capsys.readouterr().err
    )


@pytest.mark.slow
def test_the_command_prints_rows_for_a_page(tmp_path, capsys):
    words, *_ = write_bench_data(tmp_path, count=1)
    assert run("bench", "tweener", *words, "--frames", 60, "--raw", "--part", "speed", "--markdown") == 0
    title, _, head, rule, *rows = capsys.readouterr().out.splitlines()
    assert title == "tweener: speed"
    assert head.startswith("| frames | keys | poses_s | path_s | keys_and_rig_s | without_map_s |")
    assert rule == "|" + "---|" * 6
    assert [row.split(" | ")[0] for row in rows[:4]] == ["| 15", "| 30", "| 60", "| 120"]
