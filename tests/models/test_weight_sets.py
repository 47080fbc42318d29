"""Sets of weights: which file a bundled name means, what the free set refuses, and which licence is the strictest."""

import os
import re
import shutil

import pytest
from tiny_weights import FREE, MODELS, change_card, save_tiny_weights

import priors
from mapctl.errors import CheckpointError, RequestError
from priors import checkpoints, weight_sets

NOT_FREE = "CC BY-NC 4.0"


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Both sets; the free one has no `general` and no `tweener`."""
    folder = save_tiny_weights(tmp_path_factory.mktemp("weights"), NOT_FREE)
    save_tiny_weights(folder / "free", models=[name for name in MODELS if name not in ("general", "tweener")])
    return folder


@pytest.fixture
def folder(both, tmp_path, monkeypatch):
    """A copy of them, in place of those that come with the package."""
    shutil.copytree(both, tmp_path, dirs_exist_ok=True)
    monkeypatch.setenv(weight_sets.FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.delenv(weight_sets.VARIABLE, raising=False)
    return tmp_path


def test_names_mean_the_models_of_the_set_in_force(folder, monkeypatch):
    full, free = folder / "locomotion.safetensors", folder / "free" / "locomotion.safetensors"
    assert checkpoints.locate("locomotion") == full
    with priors.use_weights("free"):
        assert checkpoints.locate("locomotion") == free
        with priors.use_weights("full"):
            assert checkpoints.locate("locomotion") == full
        with priors.use_weights(None):
            assert checkpoints.locate("locomotion") == free
        assert checkpoints.locate("full/locomotion") == full
    assert checkpoints.locate("locomotion") == full
    assert checkpoints.locate("free/locomotion") == free
    monkeypatch.setenv(weight_sets.VARIABLE, "free")
    assert checkpoints.locate("locomotion") == free
    with priors.use_weights("full"):
        assert checkpoints.locate("locomotion") == full
    assert os.environ[weight_sets.VARIABLE] == "free"
    monkeypatch.setenv(weight_sets.VARIABLE, "")
    assert checkpoints.locate("locomotion") == full


def test_a_set_that_does_not_exist_is_refused(folder, monkeypatch):
    with pytest.raises(RequestError, match="must be free or full, got 'libre'"), priors.use_weights("libre"):
        pass
    assert weight_sets.VARIABLE not in os.environ
    monkeypatch.setenv(weight_sets.VARIABLE, "libre")
    with pytest.raises(RequestError, match="MAPCTL_WEIGHTS must be free or full, got 'libre'"):
        priors.load("locomotion")


def test_another_model_stands_in_where_a_set_has_none_of_its_own(folder):
    free = folder / "free"
    assert checkpoints.locate("free/locomotion-live") == free / "locomotion-live.safetensors"
    for ending in ("json", "safetensors"):
        (free / f"locomotion-live.{ending}").unlink()
    assert checkpoints.locate("free/locomotion-live") == free / "locomotion.safetensors"
    assert checkpoints.locate("locomotion-live") == folder / "locomotion-live.safetensors"
    with priors.use_weights("free"):
        assert priors.has_model("locomotion-live")
        assert not priors.has_model("tweener")
        assert priors.add_set("locomotion-live") == "free/locomotion-live"
        assert priors.load("locomotion-live").card == priors.load("locomotion").card
    assert "locomotion-live" not in weight_sets.list_models("free")


def test_what_the_free_set_lacks_is_refused_though_the_full_one_has_it(folder):
    with priors.use_weights("free"):
        with pytest.raises(CheckpointError, match=r"the free weights have no 'general': they hold denoiser, .*; full/"):
            priors.load("general")
        with pytest.raises(CheckpointError, match="no 'tweener'"):
            priors.load_tweener()
        assert priors.load("full/general").card.licence == NOT_FREE  # who names it, gets it
    with pytest.raises(CheckpointError, match="the free weights have no 'general'"):
        priors.load("free/general")
    with pytest.raises(CheckpointError, match="no prior 'nobody': neither a file nor one of denoiser"):
        priors.load("nobody")


def test_auto_chooses_among_what_the_set_has(folder):
    assert [each.name for each in priors.load_choice("auto")] == ["locomotion", "general"]
    with priors.use_weights("free"):
        assert [each.name for each in priors.load_choice("auto")] == ["locomotion"]
        assert priors.load_choice("auto")[0].card.licence == FREE


def test_a_prior_gets_the_refiner_of_its_own_set(folder):
    for name, licence in (("locomotion", NOT_FREE), ("free/locomotion", FREE)):
        refiner = priors.refiner_of(name)
        assert refiner is not None
        assert refiner.card.licence == licence
    assert priors.refiner_of("general") is None
    with priors.use_weights("free"):
        refiner = priors.refiner_of("locomotion")
        assert refiner is not None
        assert refiner.card.licence == FREE


def test_a_card_that_is_not_free_is_refused_in_the_free_set(folder):
    change_card(folder / "free" / "locomotion.json", licence=NOT_FREE)
    with pytest.raises(CheckpointError, match=r"^free/locomotion lies with the free weights, and its licence is"):
        priors.load("free/locomotion")


def test_bundled_models_of_the_free_set_are_free():
    """By their licence, and by the clips and models that their cards name."""
    for name in weight_sets.list_models("free"):
        checkpoints.note_use(f"free/{name}")
        card = checkpoints.locate(f"free/{name}").with_suffix(".json").read_text("utf-8")
        assert not re.search(r"bandai|\bdataset-[12]_|\bBY-NC|non-?commercial|full/", card, re.IGNORECASE), name


def test_what_is_loaded_is_recorded_with_its_licence(folder):
    priors.load("locomotion")
    with weight_sets.record_licences() as used:
        assert not used
        priors.load("locomotion")
        priors.load_denoiser("free/denoiser")
        checkpoints.note_use("stitcher")
        priors.load(str(folder / "general.safetensors"))
    assert used == {"locomotion": NOT_FREE, "free/denoiser": FREE, "stitcher": NOT_FREE, "general": NOT_FREE}
    assert weight_sets.find_used_licences() == {}
    assert weight_sets.describe_licences(used) == {"licence": {"strictest": NOT_FREE, "models": dict(used)}}
    assert weight_sets.format_licences(used) == f"{NOT_FREE} (locomotion, stitcher, general); {FREE} (free/denoiser)"


@pytest.mark.parametrize(
    ("held", "strictest"),
    [
        ([FREE, "CC0 1.0"], "CC0 1.0"),
        (["CC BY 4.0", FREE], "CC BY 4.0"),
        (["CC BY-NC 4.0", "CC BY 4.0", FREE], "CC BY-NC 4.0"),
        (["CC BY-NC 4.0", "that of the training data"], "that of the training data"),
        (["b", "CC BY 4.0", "a"], "a and b"),
        (["CC BY 4.0 (walk.glb)", FREE], "CC BY 4.0 (walk.glb)"),
        ([f"{FREE} (a); {NOT_FREE} (b)", "CC BY 4.0"], f"{FREE} (a); {NOT_FREE} (b)"),
        ([f"{FREE} (a); mine (b)", NOT_FREE], f"{FREE} (a); mine (b)"),
        ([], ""),
    ],
)
def test_the_strictest_licence(held, strictest):
    assert weight_sets.find_strictest(held) == strictest
