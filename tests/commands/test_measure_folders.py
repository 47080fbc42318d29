"""`mapctl measure` on folders: means, comparison with another folder, and one clear line for what cannot be."""

import json

import pytest
from helpers import bandai_skeleton, walk

from mapctl import cli, metrics, retarget
from mapctl.commands import measure
from mapctl.metrics import realism


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """A small network and few steps."""
    monkeypatch.setattr(measure, "SETTINGS", realism.RealismSettings(folds=2, steps=5))


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Five clips, two of them in a folder below and in the other format."""
    folder = tmp_path_factory.mktemp("generated")
    (folder / "below").mkdir()
    for k in range(5):
        position = folder / "below" / f"{k}.NPZ" if k % 2 else folder / f"{k}.bvh"
        walk(95, cadence=0.8 + 0.05 * k, seed=k).save(position)
    (folder / "notes.txt").write_text("not a clip")
    return folder


@pytest.fixture(scope="module")
def mocap(tmp_path_factory):
    """Four clips on another rig."""
    folder = tmp_path_factory.mktemp("mocap")
    rigmap = retarget.identify_rig(bandai_skeleton())
    for k in range(4):
        clip = walk(92, cadence=0.7 + 0.05 * k, turn_rate=0.2, seed=20 + k)
        retarget.from_canonical(clip, rigmap).save(folder / f"{k}.bvh")
    return folder


def run(*words: object) -> int:
    return cli.main(["measure", *map(str, words)])


def printed(capsys, *words: object) -> dict:
    assert run(*words, "--json") == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_a_folder_shows_the_means_of_its_clips(result, capsys):
    values = printed(capsys, result)
    rows = [metrics.measure(walk(95, cadence=0.8 + 0.05 * k, seed=k)) for k in range(5)]
    assert values["clips"] == 5
    assert values["measures"].keys() == rows[0].keys()
    for name in ("speed_m_s", "skate_cm_s", "jitter_m_s3"):
        assert values["measures"][name] == pytest.approx(sum(row[name] for row in rows) / 5, rel=1e-3)
    assert "realism" not in values
    assert run(result) == 0
    table = capsys.readouterr().out
    assert "over 5 clips" in table
    assert "largest" in table
    assert all(name in table for name in rows[0])


def test_two_folders_are_compared(result, mocap, capsys):
    values = printed(capsys, result, "--reference", mocap)
    assert (values["clips"], values["reference_clips"]) == (5, 4)
    assert values["reference"].keys() == values["measures"].keys()
    assert set(values["realism"]) == set(realism.Realism.__dataclass_fields__)
    assert 0 <= values["realism"]["accuracy"] <= 1
    assert (values["realism"]["generated_windows"], values["realism"]["mocap_windows"]) == (5 * 7, 4 * 7)


@pytest.mark.slow
def test_rigs_do_not_matter(result, tmp_path, capsys):
    """The same walks on another rig have the same measures, jitter of every joint too."""
    rigmap = retarget.identify_rig(bandai_skeleton())
    for k in range(5):
        clip = walk(95, cadence=0.8 + 0.05 * k, seed=k)
        retarget.from_canonical(clip, rigmap).save(tmp_path / f"{k}.bvh")
    ours, theirs = printed(capsys, result)["measures"], printed(capsys, tmp_path)["measures"]
    assert ours == pytest.approx(theirs, rel=1e-2, abs=1e-3)


def bad_clips(folder):
    """One that is no BVH, one of a single frame, one too short for a window; and why each is left out of what."""
    (folder / "b.bvh").write_text("HIERARCHY\nnonsense")
    walk(40).slice(0, 1).save(folder / "one.bvh")
    walk(19).save(folder / "short.bvh")
    return {str(folder / "b.bvh"): "b.bvh, line 2", str(folder / "one.bvh"): "one.bvh: measures need"}


def test_clips_that_cannot_be_measured_are_left_out_and_listed(tmp_path, capsys):
    why = bad_clips(tmp_path)
    walk(40).save(tmp_path / "a.bvh")
    values = printed(capsys, tmp_path)
    assert values["clips"] == 2  # for means 19 frames will do
    assert values["skipped"].keys() == why.keys()
    for path, reason in values["skipped"].items():
        assert why[path] in reason
        assert reason.count(path) == 1
    assert run(tmp_path) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("left out ")]
    assert len(lines) == 2


@pytest.mark.slow
def test_a_clip_too_short_for_a_window_does_not_end_the_comparison(mocap, tmp_path, capsys):
    for k in range(5):
        walk(95, cadence=0.8 + 0.05 * k, seed=k).save(tmp_path / f"{k}.bvh")
    bad_clips(tmp_path)
    values = printed(capsys, tmp_path, "--reference", mocap)
    assert (values["clips"], len(values["skipped"])) == (5, 3)
    assert "19 frames at 30 fps; a window needs at least 31" in values["skipped"][str(tmp_path / "short.bvh")]
    assert values["realism"]["generated_windows"] == 5 * 7
