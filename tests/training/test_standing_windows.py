"""Windows in which nobody goes anywhere: as many of them as is asked for are drawn, and all others."""

import pytest
import torch
from helpers import generator, go_at, run, write_corpus

import priors
from priors.training.data import Corpus, find_window_starts
from priors.training.windows import FeatureWindows

FRAMES = 20


@pytest.fixture(scope="module")
def stands() -> Corpus:
    """Ten seconds of standing, a walk that begins and ends in a stand, and steps of 0.35 m/s."""
    clips = [go_at(0.0, seconds=10), go_at(0.0, 1.2, 0.0, seconds=4), go_at(0.35, seconds=4)]
    return Corpus(("a", "b", "c"), tuple(map(len, clips)), torch.cat(clips))


def is_standing(data: Corpus, starts: torch.Tensor) -> torch.Tensor:
    """By the places, as somebody would measure it who knows nothing of the features."""
    ground, _ = data.integrate_roots()
    ends = torch.stack([ground[start + FRAMES - 1] for start in starts])
    return (ends - ground[starts]).norm(dim=-1) < 0.05


@pytest.mark.parametrize("share", [0.17, 0.5, 0.9])
def test_the_share_of_standing_windows_is_drawn_and_all_that_go(stands, share):
    everything = find_window_starts(stands.lengths, FRAMES)
    left = FeatureWindows(stands, FRAMES, standing_share=share).starts
    there, here = is_standing(stands, everything), is_standing(stands, left)
    assert set(left.tolist()) <= set(everything.tolist())
    assert int(here.sum()) / int(there.sum()) == pytest.approx(share, abs=0.05)
    assert int((~here).sum()) == int((~there).sum())
    assert bool((left.diff() > 0).all())


def test_without_a_share_nothing_is_another(stands):
    plain, told = FeatureWindows(stands, FRAMES), FeatureWindows(stands, FRAMES, standing_share=1.0)
    assert torch.equal(plain.starts, told.starts)
    assert torch.equal(plain.draw(8, generator()).first, told.draw(8, generator()).first)


def test_motion_that_only_stands_is_still_seen():
    clip = go_at(0.0, seconds=2)
    assert len(FeatureWindows(Corpus(("a",), (len(clip),), clip), FRAMES, standing_share=0.001).starts) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("small_judgements")
def test_the_command_takes_it_and_the_card_tells_it(tmp_path, capsys):
    data, out = write_corpus(tmp_path / "data"), tmp_path / "run"
    words = ("train", "lstm-gmm", "--data", data, "-o", out, "--width", 8, "--components", 2, "--window", 20)
    words = (*words, "--batch", 3, "--device", "cpu", "--quiet")
    assert run(*words, "--steps", 1, "--standing-share", 0.3) == 0
    assert priors.load(str(out)).card.training["settings"]["standing_share"] == 0.3
    assert run(*words, "--steps", 2, "--resume") == 2  # drawn from other windows
    assert "standing" in capsys.readouterr().err
    assert run(*words, "--steps", 2, "--resume", "--standing-share", 0.3) == 0
    assert run(*words, "--standing-share", 2) == 2
    assert "must be over 0 and at most 1" in capsys.readouterr().err
