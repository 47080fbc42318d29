"""`mapctl train tweener --labels`: what a run's card tells of its clips' classes."""

from dataclasses import replace

import pytest
import tiny_tweener
from helpers import write_corpus
from tiny_path import save_tiny_path

import priors
from mapctl.errors import RequestError
from priors.training.loop import train
from priors.training.recipes.tweener import TweenerRecipe, TweenerSettings

SETTINGS = replace(TweenerSettings(), steps=1, batch=3, window=32)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    predictor = str(save_tiny_path(folder / "path.safetensors"))
    data = write_corpus(folder / "data")
    return TweenerRecipe(data, folder / "run", config=tiny_tweener.CONFIG, settings=SETTINGS, path=predictor)


@pytest.mark.slow
def test_an_exported_run_knows_the_classes_of_its_training_clips(recipe):
    out = train(replace(recipe, labels=r"walk-([0-4])"), lambda line: None)
    tweener = priors.load_tweener(str(out), recipe.path)
    held_out = {name for part in tweener.card.data["held_out"].values() for name in part}
    seen = {f"{number}" for number in range(5) if f"walk-{number}.bvh" not in held_out}
    assert set(tweener.classes) == seen


def test_labels_that_cannot_be_are_refused_before_training(recipe):
    for labels, said in (("(", "regular expression"), ("walk", "needs a group"), ("(run)", "matches no clip")):
        with pytest.raises(RequestError, match=said):
            train(replace(recipe, labels=labels, out=recipe.out / "other"), lambda line: None)
        assert not list(recipe.out.glob("other/*checkpoint*"))
