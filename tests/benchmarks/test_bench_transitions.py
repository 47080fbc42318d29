"""The bench of transitions: its rows, its shares, and that no method sees what it is to make."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_transformer import tiny_transformer

from controllers.benchmarks import transitions
from controllers.benchmarks.transitions import table, twins
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl.inbetweening.retrieval import MotionCollection
from mapctl.metrics.realism import ClassifierSettings

STD = torch.full((21, 3), 0.2)
KINDS = {"walks": [walk(80, cadence=1.2)], "turns": [walk(120, turn_rate=0.5)], "short": [walk(30)]}


def oracle(part, start, stop):
    return transitions.Filled(part)


def shaken(part, start, stop, count):
    """Answers that are the truth, moved by 0, 1, 2, ... cm."""
    shift = torch.tensor([0.01, 0.0, 0.0]).double()
    return [
        transitions.Filled(replace(part, root_position=part.root_position + (count - 1 - number) * shift), 0.02)
        for number in range(count)
    ]


def prefer_the_fifth(motion):
    """How far the gap is from where the fifth answer is: 3 cm aside."""
    sideways = motion.joint_positions()[:, 0, 0].diff(n=2)  # leaps at the gap's ends
    return abs(float(sideways.abs().max()) - 0.03)


@pytest.fixture(scope="module")
def rows():
    methods = {
        "zero": transitions.hold_last_pose,
        "slerp": transitions.of_inbetweener(SlerpInbetweener(), finish=False),
        "network": transitions.of_inbetweener(tiny_transformer(drawn=0.01), finish=False),
        "retrieval": transitions.of_retrieval(MotionCollection.of(KINDS["walks"])),
        "oracle": oracle,
    }
    return transitions.benchmark_transitions(
        KINDS, methods, past=10, std=STD, baseline="slerp", samplers={"shaken": shaken}, energy=prefer_the_fifth
    )


def row_of(rows, **wanted):
    (found,) = [row for row in rows if all(row[name] == value for name, value in wanted.items())]
    return found


@pytest.mark.slow
def test_every_method_has_a_row_of_every_kind_and_length(rows):
    for length in transitions.LENGTHS:
        for kind, windows in (("walks", 1), ("turns", 2), (transitions.ALL_KINDS, 3)):
            for method in ("zero", "slerp", "network", "retrieval", "oracle", "mocap"):
                assert row_of(rows, frames=length, kind=kind, method=method)["windows"] == windows


def test_the_truth_has_no_error_and_slerp_the_share_of_one(rows):
    for length in transitions.LENGTHS:
        true = row_of(rows, frames=length, kind="walks", method="oracle")
        assert true["ade_cm"] == true["l2p"] == true["l2q"] == true["npss"] == 0
        assert row_of(rows, frames=length, kind="turns", method="slerp")["ade_share"] == pytest.approx(1)
        mocap = row_of(rows, frames=length, kind="walks", method="mocap")
        assert true["jitter_m_s3"] == pytest.approx(mocap["jitter_m_s3"])


def test_retrieval_finds_a_window_that_it_holds_and_zero_velocity_is_worst(rows):
    for length in transitions.LENGTHS:
        found, still, slerp = (
            row_of(rows, frames=length, kind="walks", method=name)["ade_cm"] for name in ("retrieval", "zero", "slerp")
        )
        assert found < 1e-3 < slerp < still


def test_means_of_kinds_are_means_and_worst_frames_the_worst(rows):
    parts = [row_of(rows, frames=15, kind=kind, method="network") for kind in ("walks", "turns")]
    mean = row_of(rows, frames=15, kind=transitions.ALL_KINDS, method="network")
    assert mean["ade_cm"] == pytest.approx(sum(part["ade_cm"] for part in parts) / 2)
    assert mean["step_cm"] == max(part["step_cm"] for part in parts)


@pytest.mark.parametrize("past", [1, 10, None])
def test_methods_get_what_is_known_and_no_frame_more(past):
    given = []

    def method(part, start, stop):
        given.append((part.num_frames, start, stop))
        return transitions.Filled(part)

    transitions.benchmark_transitions({"walks": KINDS["walks"]}, {"one": method}, past=past, std=STD, baseline="one")
    wanted = [(80, 10, 10 + n) if past is None else (past + n + 1, past, past + n) for n in transitions.LENGTHS]
    assert given == wanted


def test_what_stands_in_a_gap_does_not_matter():
    """Values of the truth within the gap, replaced by garbage, give the same answer."""
    clip = KINDS["turns"][0].slice(0, 40)
    root = clip.root_position.clone()
    root[15:30] += 3.0
    for method in (
        transitions.of_inbetweener(tiny_transformer(drawn=0.05), finish=False),
        transitions.hold_last_pose,
        transitions.of_retrieval(MotionCollection.of(KINDS["walks"])),
    ):
        one, other = (
            method(each, 15, 30).motion.joint_positions() for each in (clip, replace(clip, root_position=root))
        )
        torch.testing.assert_close(one[15:30], other[15:30], atol=1e-5, rtol=0)


def test_draws_have_the_first_the_nearest_and_their_distance(rows):
    for length in transitions.LENGTHS:
        one = row_of(rows, frames=length, kind="walks", method="shaken, one draw")
        best = row_of(rows, frames=length, kind="walks", method="shaken, best of 8 by truth")
        assert one["ade_cm"] == pytest.approx(7)
        assert best["ade_cm"] == pytest.approx(0)
        assert one["spread_cm"] == pytest.approx(3)  # mean of |a - b| of 0 to 7
        assert one["apd_cm"] == pytest.approx(3 * (21 * length) ** 0.5)
        assert one["apart_cm"] == one["apart_most_cm"] == pytest.approx(2)


def test_twins_are_windows_of_other_clips_between_the_same_poses():
    clip = walk(60)
    raised = replace(
        clip, root_position=clip.root_position + 0.02 * torch.sin(torch.arange(60) / 9.0)[:, None].double()
    )
    far = walk(60, cadence=2.5, turn_rate=1.5)
    windows = [clip.slice(10, 42)]
    assert twins.measure_twins([clip, far], windows) == {}
    found = twins.measure_twins([clip, far, raised], windows)
    assert found["twins"] == 1
    assert 0 < found["spread_cm"] < 4


def test_the_best_by_energy_is_the_answer_with_the_least_of_it(rows):
    for length in transitions.LENGTHS:
        likeliest = row_of(rows, frames=length, kind="walks", method="shaken, best of 8 by energy")
        assert likeliest["ade_cm"] == pytest.approx(3.0, abs=0.2)


def test_a_judge_of_gaps_has_seen_no_gap_of_the_same_clip(monkeypatch):
    """Made and captured gaps are of the same windows: one that has seen the one knows the other."""
    judges, train = [], table.train_judges
    monkeypatch.setattr(table, "train_judges", lambda *sets, **how: judges.append(train(*sets, **how)) or judges[-1])
    quick = replace(table._REALISM, classifier=ClassifierSettings(folds=2, steps=1, width=4, batch=8), dims=2)
    monkeypatch.setattr(table, "_REALISM", quick)
    monkeypatch.setattr(table, "LENGTHS", (30,))
    clips = [walk(120, cadence=1 + 0.1 * number) for number in range(6)]
    found = transitions.benchmark_transitions({"walks": clips}, {"oracle": oracle}, past=10, std=STD, baseline="oracle")
    (told,) = judges
    assert [len(windows) for windows in told.made] == [len(windows) for windows in told.mocap] == [2] * 6
    for fold in told.folds:
        assert fold.clips[0] == fold.clips[1]
    assert row_of(found, kind=transitions.ALL_KINDS, method="oracle")["told_apart"] == pytest.approx(0.5)
