"""Splices of clips: pieces as they are, ways that lead from the one to the other, and only what passes for mocap."""

from pathlib import Path

import pytest
import torch
from helpers import generator, run, walk
from jaxtyping import Float
from performers import Performer
from tiny_stitcher import save_tiny_stitcher
from torch import Tensor

import priors
from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.pose import decode
from mapctl.skeleton import CANONICAL
from priors.lstm_gmm import density
from priors.training import augment as module
from priors.training.augment import FOLDER, add_splices, draw_cuts
from priors.training.data import Corpus
from priors.training.recipes import lstm_gmm

pytestmark = pytest.mark.usefixtures("small_judgements")
GAPS = [15, 20, 25, 30, 35, 40, 45, 50, 55]
MOCAP = {
    "contact_speed_cm_s": 15.0,
    "penetration_cm": 0.5,
    "jitter_m_s3": 400.0,
    "largest_step_cm": 21.0,
    "largest_acceleration_m_s2": 90.0,
    "longest_slide_s": 0.2,
}
"""About what 95 % of captured clips stay under."""
ARM = CANONICAL.index("leftUpperArm")


def of_motions(**motions):
    clips = [encode(motion)[0].float() for motion in motions.values()]
    return Corpus(tuple(motions), tuple(map(len, clips)), torch.cat(clips))


def waving(frames):
    return Performer().stands(frames, turned={ARM: torch.linspace(0, 2, frames).double().sin()})


@pytest.fixture(scope="module")
def corpus():
    """One who walks, one who walks a curve, and two who stand, of whom one moves an arm."""
    return of_motions(
        walks=Performer().walks(150), turns=walk(150, turn_rate=0.5), stands=Performer().stands(100), waves=waving(120)
    )


@pytest.fixture
def all_pass(monkeypatch):
    """Whatever comes of it is kept."""
    monkeypatch.setattr(module, "_passes", lambda features, bounds: True)


@pytest.fixture
def tiny(tmp_path):
    return str(save_tiny_stitcher(tmp_path / "tiny.safetensors"))


def find_way(spliced: Float[Tensor, "frames size"], corpus: Corpus, names: list[str]) -> tuple[int, int]:
    """First frame of the way, and the first of the second piece, which are both found by the pieces' bits."""
    one, other = (corpus.clips()[corpus.names.index(name)] for name in names)
    # A walk's frames come again, so a piece is where the clip agrees for longest.
    count = max(_count_equal(one[at:], spliced) for at in range(len(one)))
    rest = max(_count_equal(other[:end].flip(0), spliced.flip(0)) for end in range(1, len(other) + 1))
    return count, len(spliced) - rest


def _count_equal(one: Float[Tensor, "frames size"], other: Float[Tensor, "others size"]) -> int:
    """How many frames are the same from the first on."""
    count = min(len(one), len(other))
    return int((one[:count] == other[:count]).all(-1).int().cumprod(0).sum())


def test_pieces_are_cut_where_somebody_stands_or_goes(corpus):
    cuts = draw_cuts(corpus, 90, GAPS, generator())
    going = {0, 1}
    assert [(cut.clips[0] in going, cut.clips[1] in going) for cut in cuts[:3]] == [
        (False, True),
        (True, False),
        (False, False),
    ]
    assert [(cut.clips[0] in going, cut.clips[1] in going) for cut in cuts] == 30 * [
        (False, True),
        (True, False),
        (False, False),
    ]
    for cut in cuts:
        for clip, piece in zip(cut.clips, (cut.first, cut.second), strict=True):
            assert piece.start >= 0
            assert min(piece.stop, corpus.lengths[clip]) - piece.start >= 45
        assert cut.gap in GAPS
    assert {cut.clips for cut in cuts[2::3]} == {(2, 2), (2, 3), (3, 2), (3, 3)}
    assert 0.3 < torch.tensor([cut.turn for cut in cuts]).std() < 0.7


@pytest.mark.slow
def test_a_splice_is_two_pieces_and_a_way_between(corpus, tiny, all_pass):
    spliced = add_splices(corpus, 12, tiny)
    assert spliced.names[:4] == corpus.names
    assert len(spliced.names) == 16
    assert torch.equal(spliced.features[: len(corpus.features)], corpus.features)
    for name, features in list(zip(spliced.names, spliced.clips(), strict=True))[4:]:
        assert name.startswith(FOLDER)
        assert features.isfinite().all()
        first, after = find_way(features, corpus, name.removeprefix(FOLDER).split(" + "))
        assert first >= 45
        assert len(features) - after >= 44
        assert 14 <= after - first - 1 <= 24  # what the tiny one fills at most, and the pose at which it arrives
        # The pose at the end of the way is the second piece's first.
        held = slice(LAYOUT.slices["root_height"].start, LAYOUT.continuous)
        clip = corpus.clips()[corpus.names.index(name.split(" + ")[1])]
        number = next(k for k in range(1, len(clip)) if torch.equal(clip[k], features[after]))
        assert (features[after - 1, held] - clip[number - 1, held]).abs().max() < 1e-4


@pytest.mark.slow
def test_the_bundled_stitcher_passes_for_mocap_and_a_wild_one_does_not(corpus, tmp_path, monkeypatch):
    asked = []

    def find(clips):
        asked.append({motion.num_frames for motion in clips})
        return MOCAP

    monkeypatch.setattr(module, "find_bounds", find)  # feet that stand to the hair are not what mocap is like
    wild = str(save_tiny_stitcher(tmp_path / "wild.safetensors", drawn=30.0))
    assert len(add_splices(corpus, 18, wild).names) == 4
    assert len(asked) == 3  # who sets off, who stops, who stands: each is bounded by what it is made of
    assert {100, 120} in asked
    assert {100, 120, 150} in asked
    kept = add_splices(corpus, 18)
    assert len(kept.names) > 4 + 4
    for features in kept.clips()[4:]:
        places = decode(features, GroundPose.origin()).joint_positions()
        assert torch.diff(places, dim=0).norm(dim=-1).max() < 0.25  # metres in a frame


@pytest.mark.slow
def test_they_are_kept_for_a_run_that_goes_on(corpus, tmp_path, all_pass, monkeypatch):
    one, other = (
        str(save_tiny_stitcher(tmp_path / f"{name}.safetensors", drawn=drawn))
        for name, drawn in (("a", 1.0), ("b", 3.0))
    )
    cache = tmp_path / "cache"
    made = add_splices(corpus, 4, one, cache)
    (stored,) = cache.iterdir()
    with monkeypatch.context() as within:
        within.setattr(module, "_walk_all", lambda *_: pytest.fail("made anew"))
        again = add_splices(corpus, 4, one, cache)
    assert torch.equal(again.features, made.features)
    assert (again.names, again.lengths) == (made.names, made.lengths)
    # Nothing else is taken for them.
    some = corpus.subset(range(1, len(corpus.names)))
    for (count, name, seed), clips in (
        ((5, one, 1), corpus),
        ((4, other, 1), corpus),
        ((4, one, 2), corpus),
        ((4, one, 1), some),
    ):
        assert not torch.equal(add_splices(clips, count, name, cache, seed=seed).features, made.features)
    assert len(list(cache.iterdir())) == 5
    stored.write_bytes(b"damaged")
    assert torch.equal(add_splices(corpus, 4, one, cache).features, made.features)


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    for number in range(3):
        Performer().walks(120 + number).save(folder / f"walk_{number}.bvh")
        waving(100 + number).save(folder / f"wave_{number}.bvh")
    return folder


def train(data: Path, out: Path, *words: object) -> int:
    small = ("--width", 8, "--components", 2, "--window", 20, "--batch", 3, "--device", "cpu", "--steps", 2)
    return run("train", "lstm-gmm", "--data", data, "-o", out, *small, *words)


@pytest.mark.slow
def test_a_density_is_trained_on_them_and_its_card_says_so(data, tmp_path, tiny, all_pass, capsys):
    assert train(data, tmp_path / "alone", "--quiet") == 0
    capsys.readouterr()
    assert train(data, tmp_path / "run", "--splices", 9, "--stitcher", tiny) == 0
    assert "9 of 9 splices pass for mocap" in capsys.readouterr().out
    card, alone = (priors.load(str(tmp_path / name)).card for name in ("run", "alone"))
    assert (card.data["splices"], card.data["stitcher"]) == ("9", str(tiny))
    assert card.data["held_out"] == alone.data["held_out"]
    assert card.data["trained_on"]["clips"] == alone.data["trained_on"]["clips"] + 9
    assert "splices" not in alone.data


@pytest.mark.slow
def test_a_splice_has_no_label_and_no_start_lies_in_one(data, tmp_path, tiny, all_pass):
    seen, read_labels = [], density.read_labels

    def see(names, pattern):
        seen.append((names, read := read_labels(names, pattern)))
        return read

    words = ("--splices", 9, "--stitcher", tiny, "--quiet", "--labels", "(?P<what>walk|wave)")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lstm_gmm.density, "read_labels", see)
        assert train(data, tmp_path / "run", *words) == 0
    names, read = seen[0]
    assert names.count("") == 9
    assert [bool(row.any()) for row in read.held] == [name != "" for name in names]
    card = priors.load(str(tmp_path / "run")).card
    assert {"walk", "wave"} == {start.split("_")[0] for start in card.data["starts"]}


@pytest.mark.slow
def test_clips_that_are_held_out_are_in_no_splice(data, tmp_path, tiny, all_pass):
    seen = []

    def see(corpus, *request, **seed):
        seen.append(corpus.names)
        return add_splices(corpus, *request, **seed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("priors.training.recipes.lstm_gmm.add_splices", see)
        assert train(data, tmp_path / "run", "--splices", 9, "--stitcher", tiny, "--quiet") == 0
    held = priors.load(str(tmp_path / "run")).card.data["held_out"]
    (names,) = seen
    assert held
    assert not {name for part in held.values() for name in part} & {*names}
