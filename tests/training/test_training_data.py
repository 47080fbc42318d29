"""Folders of clips as a corpus: frames that count, level floors, caches, splits, starts, paces; what cannot be used."""

import math
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import mocap_folders
import numpy as np
import pytest
import torch
from helpers import bandai_skeleton, corpus, generator, go_at, moved, quat_xyzw, run, walk, walks, write_corpus
from performers import Performer
from trainable_models import small_settings

import priors
from mapctl import retarget, rotations
from mapctl.contacts import detect_contacts
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, GroundPose, encode, ground_speed
from mapctl.motion import Motion
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors.lstm_gmm.density import PACE_LABELS, Labels, read_pace_rates
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig
from priors.training import data as corpora
from priors.training.data import (
    Corpus,
    Cut,
    FrameCuts,
    compute_feature_statistics,
    find_floor_slope,
    follow_paces,
    measure_pace_changes,
    read_clip_features,
    read_corpus,
    stand_on_canonical,
    turn_level,
)
from priors.training.recipes.denoiser import DenoiserTrainer
from priors.training.recipes.lstm_gmm import DensityTrainer, measure_data_limits, select_initial_states


def test_the_corpus_is_the_features_of_the_clips_and_is_read_once(tmp_path, data, monkeypatch):
    read = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert read.names == ("walk-0.bvh", "walk-1.bvh", "walk-2.bvh")
    expected = corpus(3, frames=80)
    torch.testing.assert_close(read.features, expected.features, atol=1e-5, rtol=1e-5)
    monkeypatch.setattr(corpora, "read_clip_features", None)  # nothing can be read
    again = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert torch.equal(again.features, read.features)
    assert (again.names, again.lengths) == (read.names, read.lengths)
    (data / "walk-0.bvh").touch()
    with pytest.raises(RequestError, match="none of the 3"):  # a changed file is read anew
        corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)


@pytest.mark.parametrize("content", [b"", b"not a corpus", None])
def test_a_damaged_cache_is_read_anew(tmp_path, data, content):
    whole = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    (stored,) = tmp_path.iterdir()
    stored.write_bytes(stored.read_bytes()[:-100] if content is None else content)
    again = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert torch.equal(again.features, whole.features)
    assert corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path).names == whole.names


def test_a_cache_of_other_rig_tables_or_contact_thresholds_is_not_taken(tmp_path, data, monkeypatch):
    corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    table, contacts = corpora.rigs.known_rigs(), corpora.ContactSettings
    for what, other in (
        ("rigs.known_rigs", lambda: (*table[:-1], replace(table[-1], rest="straighten"))),
        ("ContactSettings", partial(contacts, slow=0.4)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(f"priors.training.data.{what}", other)
            patch.setattr(corpora, "read_clip_features", None)
            with pytest.raises(RequestError, match="none of the 3"):
                corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)


def test_the_split_is_by_clip_seeded_and_complete():
    many = corpora.Corpus(tuple(map(str, range(60))), (80,) * 60, torch.zeros(4800, LAYOUT.size))
    first, again, other = (corpora.split_corpus(many, seed) for seed in (1, 1, 2))
    parts = [set(part.names) for part in (first.train, first.validation, first.test)]
    assert [len(part) for part in parts] == [54, 3, 3]
    assert set.union(*parts) == set(many.names)
    assert first.test.names == again.test.names
    assert first.test.names != other.test.names


def test_windows_stay_within_their_clips():
    found = corpora.find_window_starts((5, 2, 4), 3).tolist()
    assert found == [0, 1, 2, 7, 8]
    with pytest.raises(RequestError, match="no clip is as long as the window of 9 frames"):
        corpora.find_window_starts((5, 2, 4), 9)


BALL = (
    "HIERARCHY\nROOT Ball\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\n"
)
ONE_FRAME = "one.bvh: features need at least two frames"


pytestmark = pytest.mark.usefixtures("small_judgements")


def write_walks(folder, *lengths):
    """Walks of so many frames, as BVH files of the Bandai Namco rig."""
    folder.mkdir(parents=True)
    rigmap = retarget.identify_rig(bandai_skeleton())
    for number, motion in enumerate(walks(len(lengths), max(lengths))):
        motion = motion.slice(0, lengths[number])
        retarget.from_canonical(motion, rigmap).save(folder / f"walk-{number}.bvh")
    return folder


@pytest.fixture
def mixed(tmp_path, data):
    """Five walks among files of every kind that a folder may hold."""
    folder = shutil.copytree(data, tmp_path / "data")
    text = (folder / "walk-0.bvh").read_text()
    (folder / "broken.bvh").write_text(text[:300])
    (folder / "empty.bvh").touch()
    (folder / "folder.bvh").mkdir()
    (folder / "lost.bvh").symlink_to(tmp_path / "gone")
    (folder / "other.bvh").write_text(f"{BALL}MOTION\nFrames: 2\nFrame Time: 0.04\n0 0 0\n1 0 0\n")
    write_walks(tmp_path / "short", 2, 1)
    shutil.copy(tmp_path / "short" / "walk-1.bvh", folder / "one.bvh")
    return folder


BAD = ("broken.bvh", "empty.bvh", "lost.bvh", "one.bvh", "other.bvh")


@pytest.mark.slow
def test_files_that_cannot_be_used_are_left_out_and_listed(tmp_path, data, mixed, capsys):
    found = small_settings("path", mixed, tmp_path / "run").gather().whole
    whole = small_settings("path", data, tmp_path / "whole").gather().whole
    assert found.names == whole.names
    assert torch.equal(found.features, whole.features)
    assert set(found.skipped) == set(BAD)
    assert capsys.readouterr().err.startswith(f"mapctl: left out 5 of 10 files: {mixed / 'broken.bvh'}: ")
    listed = (tmp_path / "run" / "skipped.txt").read_text().splitlines()
    assert [line.split(":")[0] for line in listed] == list(BAD)
    assert ONE_FRAME in listed


def test_a_folder_of_nothing_else_is_refused(tmp_path, mixed):
    with pytest.raises(RequestError, match=rf"none of the 1 \.bvh below .* can be trained on \({mixed / ONE_FRAME}\)"):
        small_settings("path", mixed, tmp_path / "run", match="one").gather()
    assert not (tmp_path / "run").exists()


def test_of_few_clips_the_end_of_the_longest_is_held_out():
    few = corpora.Corpus(("a", "b"), (100, 1000), corpus(11).features)
    parts = corpora.split_corpus(few, 1)
    assert (parts.train.names, parts.train.lengths) == (("a", "b"), (100, 890))
    assert parts.test is parts.validation
    assert (parts.test.names, parts.test.lengths) == (("b[890:1000]",), (110,))
    assert torch.equal(torch.cat([parts.train.features, parts.test.features]), few.features)


def test_what_is_left_of_a_clip_is_no_clip_where_it_is_a_frame():
    few = corpora.Corpus(("a", "b"), (76, 76), corpus(2, 76).features)
    assert corpora.split_corpus(few, 1).train.names == ("b",)


@pytest.mark.parametrize(("lengths", "got"), [((74, 70), "74, 70"), ((100,), "100"), ((149,), "149")])
def test_too_little_is_refused_with_what_would_do(lengths, got):
    few = corpora.Corpus(tuple("ab"[: len(lengths)]), lengths, torch.zeros(sum(lengths), corpus(1).features.shape[1]))
    message = f"training needs 75 frames at 30 fps, and 75 to hold out in the longest clip; got clips of {got}"
    with pytest.raises(RequestError, match=f"^{message}$"):
        corpora.split_corpus(few, 1)


def test_a_window_longer_than_what_is_held_out_does_not_end_a_run(tmp_path):
    trainer = DenoiserTrainer(small_settings("denoiser", tmp_path, tmp_path, window=90), corpus(2, 100))
    assert trainer.validate(corpus(1, 80))["error_cm"] > 0


STYLES = {
    "Aeroplane": {"FW": (10, 200, 15), "ID": (0, 180, 20), "TR1": (12, 170, 0)},
    "Zombie": {"FW": (33, 160, 7), "SR": (8, 190, 8)},
}
"""Frames at 60 a second before, of and after the motion."""
LABELS = r"(?P<style>[A-Za-z]+)_(?P<gait>[A-Z]+\d?)\.bvh$"


@pytest.fixture(scope="module")
def styles(tmp_path_factory):
    return mocap_folders.write_styles(tmp_path_factory.mktemp("styles") / "100STYLE", STYLES)


@pytest.fixture
def files(tmp_path):
    """Three walks of 80 frames at 30 a second."""
    return write_corpus(tmp_path / "data", 3)


def read(folder, tmp_path, **more):
    return read_corpus(folder, match="", cache=tmp_path / "cache", **more)


def table(tmp_path, *rows):
    path = tmp_path / "cuts.csv"
    path.write_text("\n".join(("file,first,last", *rows)) + "\n")
    return path


@pytest.mark.slow
def test_a_table_in_the_folder_is_found_and_leaves_the_motion(styles, tmp_path):
    found = read(styles, tmp_path)
    expected = {
        f"{style}/{style}_{kind}.bvh": encode(walk(frames, turn_rate=0.2 * number, seed=number, fps=60).resample(30))[0]
        for number, (style, clips) in enumerate(STYLES.items())
        for kind, (_, frames, _) in clips.items()
    }
    assert found.names == tuple(expected)
    for name, clip in zip(found.names, found.clips(), strict=True):
        torch.testing.assert_close(clip, expected[name].float(), atol=2e-5, rtol=0)
    assert found.cuts == ("Frame_Cuts.csv: 5 of 5 clips",)
    assert found.skipped == {}


@pytest.mark.slow
def test_a_given_table_counts_before_one_that_is_found(styles, tmp_path):
    found = read(styles, tmp_path, cuts=table(tmp_path, "Zombie_FW.bvh,33,92", "Aeroplane/Aeroplane_ID,0,"))
    lengths = dict(zip(found.names, found.lengths, strict=True))
    assert lengths["Zombie/Zombie_FW.bvh"] == 30
    assert lengths["Aeroplane/Aeroplane_ID.bvh"] == 100  # to the end, the T-pose too
    assert lengths["Aeroplane/Aeroplane_FW.bvh"] == 100
    assert sorted(found.cuts) == ["Frame_Cuts.csv: 3 of 5 clips", "cuts.csv: 2 of 5 clips"]


@pytest.mark.parametrize(
    ("rows", "lengths"),
    [
        (("walk-0.bvh,5,44",), (40, 80, 80)),
        (("walk-0,5,44", "walk-1,,9"), (40, 10, 80)),
        (("*,8,",), (72, 72, 72)),
        (("walk-[12],8,", "*,10,", "walk-2,0,"), (70, 72, 80)),
        (("data/walk-0.bvh,5,44",), (80, 80, 80)),
    ],
)
def test_rows_name_files_their_ends_and_patterns(files, tmp_path, rows, lengths):
    assert read(files, tmp_path, cuts=table(tmp_path, *rows)).lengths == lengths


def test_takes_of_cmu_have_a_table_that_comes_with_mapctl(files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (files / "walk-1.bvh").rename(files / "07_01.bvh")
    assert read(files, tmp_path, cuts=Path("cmu")).cuts == ("cmu_cuts.csv: 1 of 3 clips",)
    assert read(files, tmp_path, cuts=Path("cmu")).lengths[0] == 80 - 8
    (tmp_path / "cmu").write_text("file,first,last\n07_01,20,59\n")
    assert read(files, tmp_path, cuts=Path("cmu")).lengths[0] == 40


def test_a_file_too_short_for_its_cut_is_left_out_and_reported(files, tmp_path):
    found = read(files, tmp_path, cuts=table(tmp_path, "walk-0,5,80", "walk-1,79,", "walk-2,0,79"))
    assert found.names == ("walk-2.bvh",)
    assert set(found.skipped) == {"walk-0.bvh", "walk-1.bvh"}
    assert "frames 5 to 80 are to be taken, but it has 80" in found.skipped["walk-0.bvh"]


@pytest.mark.parametrize(
    "text",
    [
        "file,first,last\nwalk,1\n",
        "file,first,last\nrun,one,9\n",
        "file,first,last\nwalk,-1,9\n",
        "file,first,last\nwalk,20,9\n",
        "file,first,last\nwalk,2,9\nwalk.bvh,2,9\n",
        "name,first,last\n",
        "STYLE_NAME,FW_START\n",
        "STYLE_NAME,FW_START,FW_STOP\nOld,5\n",
        "STYLE_NAME,FW_START,FW_STOP\nOld,x,5\n",
        "",
    ],
)
def test_what_makes_no_sense_is_named(files, tmp_path, capsys, text):
    (tmp_path / "cuts.csv").write_text(text)
    words = ("train", "lstm-gmm", "--data", files, "-o", tmp_path / "run", "--cuts", tmp_path / "cuts.csv", "--quiet")
    assert run(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"mapctl: {tmp_path / 'cuts.csv'}")


def test_a_table_of_styles_lists_which_clips_there_are(tmp_path):
    (tmp_path / "Frame_Cuts.csv").write_text(
        "STYLE_NAME,FW_START,FW_STOP,ID_START,ID_STOP\nOld,5,50,N/A,N/A\nNew,,60,7,\n"
    )
    found = FrameCuts.of_folder(tmp_path)
    assert found.find("Old/Old_FW.bvh") == ("Frame_Cuts.csv", Cut(5, 50))
    assert found.find("Old/Old_ID.bvh") == ("", None)
    assert found.find("New_FW.BVH")[1] == Cut(0, 60)
    assert found.find("New_ID.bvh")[1] == Cut(7, None)
    assert found.find("New_FWD.bvh")[1] is None


SMALL = Performer(size=0.9, toe_height=-0.03)
"""Clip with toes under the floor of the file."""


def sloping(motion: Motion, along_x: float, along_z: float) -> Motion:
    """As recorded where the floor rises so much a metre."""
    size = math.hypot(along_x, along_z)
    axis = torch.tensor([-along_z, 0.0, along_x], dtype=torch.float64) / size
    turn = quat_xyzw(math.atan(size) * axis).expand(motion.num_frames, 4)
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(turn, local[:, 0])
    return replace(motion, root_position=rotations.rotate(turn, motion.root_position), local_quat_xyzw=local)


def planted(motion: Motion):
    return detect_contacts(motion.joint_positions()[:, list(TOE_JOINTS)], float(motion.fps))


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.5, -1.6])
@pytest.mark.parametrize("slope", [0.022, -0.01])
def test_a_slope_along_the_walk_is_found_and_turned_out(slope, heading):
    level = moved(SMALL.walks(120), turn=heading, shift=(3.0, -2.0))
    along = (slope * math.sin(heading), slope * math.cos(heading))
    walked = sloping(level, *along)
    found = find_floor_slope(walked)
    assert found.tolist() == pytest.approx(along, abs=0.0015)
    turned = turn_level(walked, torch.tensor(along).double())
    assert (
        turned.joint_positions()[..., 1].diff(dim=0) - level.joint_positions()[..., 1].diff(dim=0)
    ).abs().max() < 1e-4
    before, after = (rotations.split_heading(motion.local_quat_xyzw[:, 0])[0] for motion in (level, turned))
    assert (before - after).abs().max() < 1e-3


def test_contacts_are_those_of_the_level_floor():
    level = SMALL.walks(150)
    walked = sloping(level, 0.0, 0.022)
    wanted, seen = planted(level), planted(walked)
    assert seen.float().mean() < 0.6 * wanted.float().mean()
    turned = planted(turn_level(walked, find_floor_slope(walked)))
    assert (turned == wanted).float().mean() > 0.98


@pytest.mark.parametrize(
    "motion",
    [Performer(stair=0.17).walks(150), SMALL.walks(1), SMALL.walks(6), sloping(SMALL.walks(150), 0.0, 0.09)],
    ids=["stair", "a frame", "a few frames", "a ramp"],
)
def test_what_is_no_fault_of_the_capture_stays(motion):
    assert find_floor_slope(motion).tolist() == [0, 0]
    assert turn_level(motion, torch.zeros(2).double()) is motion


def test_toes_that_stand_on_no_plane_tell_no_slope():
    rough = SMALL.walks(150)
    root = rough.root_position.clone()
    root[:, 1] += 0.05 * torch.sin(2.5 * root[:, 2] + 0.5)  # over a rolling ground, as slowly as toes that stand
    assert find_floor_slope(replace(rough, root_position=root)).tolist() == [0, 0]


@pytest.mark.parametrize("performer", [SMALL, Performer(size=1.2, leg=0.9, toe_height=0.1), Performer(leg=1.1)])
def test_features_decode_to_feet_that_stand_on_the_canonical_floor(performer):
    walked = sloping(performer.walks(120), 0.0, 0.02)
    rigmap = retarget.identify_rig(walked.skeleton)
    features, start = encode(stand_on_canonical(walked, rigmap))
    pose = BodyPose.of_features(features, start)
    toes = pose.joints_world(CANONICAL)[:, list(TOE_JOINTS)]
    stands = features[:, -2:] > 0.5
    assert 0.45 < float(stands.double().mean()) < 0.75
    assert toes[stands][:, 1].quantile(0.5) == pytest.approx(TOE_REST_HEIGHT, abs=0.004)
    assert toes[..., 1].min() > TOE_REST_HEIGHT - 0.01
    speed = torch.diff(toes, dim=0)[..., ::2].norm(dim=-1) * 30
    both = stands[1:] & stands[:-1]
    assert speed[both].mean() < 0.04
    assert speed[both].quantile(0.98) < 0.25


@pytest.mark.slow
def test_a_file_is_read_so_where_it_is_asked_for(tmp_path):
    walked = sloping(SMALL.walks(120), 0.0, 0.02)
    walked.save(tmp_path / "walk.bvh")
    plain, level = (read_clip_features(tmp_path / "walk.bvh", level=level) for level in (False, True))
    assert plain.shape == level.shape
    rests = [
        BodyPose.of_features(features, GroundPose.origin()).joints_world()[:, list(TOE_JOINTS), 1].quantile(0.1)
        for features in (plain, level)
    ]
    assert rests[0] < 0.01
    assert rests[1] == pytest.approx(TOE_REST_HEIGHT, abs=0.005)
    part = read_clip_features(tmp_path / "walk.bvh", cut=Cut(10, 100), level=True)
    assert len(part) == 90


def tiny_network() -> LstmGmm:
    mean, std = compute_feature_statistics(corpus().features)
    torch.manual_seed(0)
    return LstmGmm(LstmGmmConfig(width=8, components=2), mean=mean, std=std)


def test_starts_are_the_states_after_stretches_of_clips():
    data = corpus()
    network = tiny_network()
    found = select_initial_states(network, data, count=3, generator=generator())
    assert len(set(found.names)) == 3
    clips = dict(zip(data.names, data.clips(), strict=True))
    for row, name in enumerate(found.names):
        clip = clips[name]
        end = 1 + int((clip == found.state.last_frame[row]).all(-1).nonzero()[0])
        expected = network.advance(network.start_after(clip[:1]), clip[None, 1:end])
        torch.testing.assert_close(found.state.hidden[:, row], expected.hidden[:, 0])
        assert float(found.speed[row]) == pytest.approx(float(ground_speed(clip[end - 30 : end]).mean()), rel=1e-5)


def test_abilities_are_the_speeds_and_turns_of_the_data():
    found = measure_data_limits(corpus())
    speeds = [float(ground_speed(clip).mean()) for clip in corpus().clips()]
    assert min(speeds) * 0.9 < found.slowest < found.fastest < max(speeds) * 1.05
    assert found.turn_rate == pytest.approx(0.3, abs=0.05)
    still = Corpus(("still",), (80,), torch.zeros(80, LAYOUT.size))
    assert measure_data_limits(still).turn_rate == 0


def walks_and_runs() -> tuple[Corpus, torch.Tensor]:
    """Fifteen clips: nine of a kind, five of another, one of a third."""
    walks = corpus(5)
    data = Corpus(
        tuple(f"{kind}_{number}" for kind in "abc" for number in range(5)),
        walks.lengths * 3,
        walks.features.repeat(3, 1),
    )
    kinds = torch.tensor([0] * 9 + [1] * 5 + [2])
    return data, torch.nn.functional.one_hot(kinds).float()


def test_each_combination_of_labels_has_starts_in_proportion_and_none_is_left_out():
    data, labels = walks_and_runs()
    for count, expected in ((3, [1, 1, 1]), (6, [3, 2, 1]), (15, [9, 5, 1]), (40, [9, 5, 1])):
        found = select_initial_states(tiny_network(), data, count=count, generator=generator(), labels=labels)
        kinds = labels[[data.names.index(name) for name in found.names]]
        assert kinds.sum(0).tolist() == expected
        assert (found.weight @ kinds).tolist() == pytest.approx([9 / 15, 5 / 15, 1 / 15])


WINDOW = 20


@pytest.fixture(scope="module")
def clips() -> Corpus:
    """A stand, a start with a stop, and a run after a walk."""
    parts = [go_at(0.0, seconds=4), go_at(0.0, 1.2, 0.0, seconds=3), go_at(1.2, 3.0, seconds=3)]
    return Corpus(("a", "b_walk", "c"), tuple(map(len, parts)), torch.cat(parts))


@pytest.fixture
def trainer(clips, tmp_path):
    names = ("gait=walk", *PACE_LABELS)
    known = Labels(("gait=walk",), torch.tensor([[0.0], [1.0], [0.0]])).renamed(names)
    settings = small_settings("lstm-gmm", tmp_path, tmp_path, batch=64, window=WINDOW)
    return DensityTrainer(settings, clips, LstmGmmConfig(width=4, labels=names), known, follow_paces(clips))


def test_a_window_is_labelled_by_how_it_ends(trainer, clips, monkeypatch):
    paces, seen = follow_paces(clips), set()
    drawn = trainer.windows.draw(64, generator(3))
    monkeypatch.setattr(trainer.windows, "draw", lambda *_, **__: drawn)
    _, shown = trainer.draw_windows()
    for row, first in zip(shown, drawn.first.tolist(), strict=True):
        ends = int(paces[first + WINDOW])
        assert row[1:].tolist() in (np.eye(3)[ends].tolist(), [0, 0, 0])  # some windows are shown no pace
        seen.add((int(paces[first]), ends))
    assert {(0, 0), (0, 1), (1, 0), (1, 2)} <= seen


def test_rates_are_those_of_the_clips(clips):
    holds = measure_pace_changes(clips)
    minutes = holds["minutes by pace"]
    assert sum(minutes.values()) == pytest.approx(len(clips.features) / 1800, abs=0.02)
    rates = read_pace_rates(holds)
    assert rates["stand", "walk"] == pytest.approx(1 / (60 * minutes["stand"]))
    assert rates["walk", "stand"] == pytest.approx(1 / (60 * minutes["walk"]))
    assert rates["walk", "run"] == pytest.approx(1 / (60 * minutes["walk"]))
    assert rates["run", "walk"] == 0.0
    nobody = holds | {"minutes by pace": {"stand": 1.0, "walk": 2.0, "run": 0.0}}
    assert set(read_pace_rates(nobody)) == {("stand", "walk"), ("walk", "stand")}


@pytest.mark.slow
def test_a_density_that_is_trained_so_knows_paces(tmp_path, capfd):
    data = write_corpus(tmp_path / "data")
    words = "--match", "", "--width", 8, "--steps", 2, "--batch", 4, "--window", 12
    assert run("train", "lstm-gmm", "--data", data, "-o", tmp_path / "run", *words, "--label-pace") == 0
    prior = priors.load(str(tmp_path / "run"))
    assert prior.labels == {"pace": ["stand", "walk", "run"]}
    assert prior.pace_rates == read_pace_rates(prior.card.data["holds"])
    starts = prior.conditioned_on(["walk"]).initial_states
    assert bool((starts.speed > 0.4).all())
    given = prior.conditioned_on(["pace=run"]).reference.fc1.bias
    assert not torch.equal(given, prior.reference.fc1.bias)
    # A run that goes on with it has its labels, and one that begins without them is refused.
    more = ("--data", data, "--match", "", "--steps", 1, "--batch", 4, "--window", 12)
    for out, words in (("on", ("--label-pace",)), ("unasked", ())):
        assert run("train", "lstm-gmm", "-o", tmp_path / out, *more, *words, "--init", tmp_path / "run") == 0
        assert priors.load(str(tmp_path / out)).labels == prior.labels
    assert run("train", "lstm-gmm", "-o", tmp_path / "plain", *more, "--width", 8) == 0
    assert priors.load(str(tmp_path / "plain")).pace_rates == {}
    capfd.readouterr()
    assert run("train", "lstm-gmm", "-o", tmp_path / "no", *more, "--label-pace", "--init", tmp_path / "plain") == 2
    assert "was not trained with labels of paces; leave --label-pace out" in capfd.readouterr().err
