"""What each model that comes with mapctl is trained with: one table, by which `mapctl train all` makes them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mapctl.errors import RequestError
from priors.lstm_gmm.network import LstmGmmConfig
from priors.stitching.network import StitcherConfig
from priors.training.ending.course import UntilFlat
from priors.training.recipe import Recipe
from priors.training.recipes.denoiser import DenoiserRecipe, DenoiserSettings
from priors.training.recipes.infiller import InfillerRecipe
from priors.training.recipes.keyframe_timing import KeyframeTimingRecipe
from priors.training.recipes.lstm_gmm import DensityRecipe, TrainingSettings
from priors.training.recipes.path import PathRecipe
from priors.training.recipes.pose_transformer import PoseTransformerRecipe, PoseTransformerSettings
from priors.training.recipes.refiner import AdversarialSettings, RefinerRecipe
from priors.training.recipes.stitcher import StitcherRecipe, StitcherSettings
from priors.training.recipes.tweener import TweenerRecipe

DATA, RUN = Path("DATA"), Path("RUN")
"""What a card's command calls the folders of clips and of the run."""
USUAL_SEED = 1
"""Seed by which clips are kept from training, whatever the seed of all else."""
AnyRecipe = Recipe[Any, Any, Any]


@dataclass(frozen=True)
class Clips:
    """Which clips a set of models is trained on, and under which licence their weights then are."""

    licence: str
    """Of the weights."""
    match: str = ""
    """Regular expression for the paths of all clips below the data folder."""
    locomotion: str = ""
    """The same for those of walks and runs."""
    labels: str = ""
    """Regular expression whose groups read gait and style from them; nothing where names do not tell."""
    skip_first: bool = False
    """Leave out frame 0 of walks and runs (the T-pose of CMU takes)."""


SETS: Mapping[str, Clips] = {
    "full": Clips(
        licence="CC BY-NC 4.0",
        locomotion="dataset-2_(walk|walk-turn-left|walk-turn-right|run)_",
        labels="_(?P<gait>run|walk|walk-turn-left|walk-turn-right)_(?P<style>[a-z]+)_",
    ),
    "free": Clips(
        licence="free for any use",
        match="^cmu",
        locomotion=r"^cmu.*/(02_0[123]|05_01|06_01|07_\d+|08_\d+|09_\d+|10_04)\.",
        skip_first=True,
    ),
}
"""Sets of models by their names: all that Bandai Namco and the CMU database hold, and what the latter holds alone."""


@dataclass(frozen=True)
class BundledModel:
    """A model by the name that commands know it by."""

    name: str
    """As `--prior`, `--denoiser` and others call it."""
    recipe: AnyRecipe
    """How it is trained, in a folder that is called RUN on a folder that is called DATA."""
    needs: Mapping[str, str] = field(default_factory=dict)
    """Models that have to be there before, by the option that takes them."""

    @property
    def command(self) -> str:
        """What to type for it, as its card names it."""
        return self.recipe.format_command()


def list_models(weights: str = "full", *, match: str | None = None, seed: int = USUAL_SEED) -> tuple[BundledModel, ...]:
    """List the models of a set, each after those that it needs; `match` chooses clips of one's own for the densities of
    walks and runs, without labels. RequestError for a set that does not exist."""
    if weights not in SETS:
        raise RequestError(f"the weights are {' or '.join(SETS)}, got {weights!r}")
    clips = SETS[weights] if match is None else replace(SETS[weights], locomotion=match, labels="")
    return tuple(_seed(model, seed) for model in _make_models(clips))


RECIPES: Mapping[str, type[AnyRecipe]] = {
    recipe.kind: recipe
    for recipe in (
        DensityRecipe,
        RefinerRecipe,
        PathRecipe,
        TweenerRecipe,
        StitcherRecipe,
        PoseTransformerRecipe,
        DenoiserRecipe,
        InfillerRecipe,
        KeyframeTimingRecipe,
    )
}
"""Recipes by the kind of model that a card names."""


def _make_models(clips: Clips) -> tuple[BundledModel, ...]:
    """The table. Steps are a plan, where a run goes on until its curve is flat."""
    shared: dict[str, Any] = {"data": DATA, "out": RUN, "licence": clips.licence}
    timing: dict[str, Any] = {**shared, "match": clips.match or None, "skip_first": True}
    everything: dict[str, Any] = {**timing, "until_flat": UntilFlat()}
    general: dict[str, Any] = {**everything, "match": clips.match}  # which a density's command always tells
    walks: dict[str, Any] = {
        **shared,
        "match": clips.locomotion,
        "labels": clips.labels,
        "skip_first": clips.skip_first,
        "until_flat": UntilFlat(),
    }
    return (
        BundledModel("locomotion", DensityRecipe(**walks, **_density(width=256, steps=10_000))),
        BundledModel("locomotion-live", DensityRecipe(**walks, **_density(width=160, steps=10_000))),
        BundledModel("general", DensityRecipe(**general, **_density(width=256, steps=12_000))),
        BundledModel(
            "locomotion-refiner",
            RefinerRecipe(
                **shared, skip_first=clips.skip_first, settings=AdversarialSettings(rounds=3000, bfloat16=True)
            ),
            needs={"--density": "locomotion"},
        ),
        BundledModel("path", PathRecipe(**everything)),
        BundledModel("tweener", TweenerRecipe(**everything), needs={"--path": "path"}),
        BundledModel(
            "stitcher",
            StitcherRecipe(
                **everything, config=StitcherConfig(without=("d",)), settings=StitcherSettings(bfloat16=True)
            ),
        ),
        BundledModel(
            "transformer", PoseTransformerRecipe(**everything, settings=PoseTransformerSettings(bfloat16=True))
        ),
        BundledModel("denoiser", DenoiserRecipe(**everything, settings=DenoiserSettings(bfloat16=True))),
        BundledModel("keyframe-timing", KeyframeTimingRecipe(**timing)),
    )


def _density(*, width: int, steps: int) -> dict[str, Any]:
    settings = TrainingSettings(steps=steps, batch=64, bfloat16=True)
    return {"config": LstmGmmConfig(width=width), "settings": settings}


def _seed(model: BundledModel, seed: int) -> BundledModel:
    """With another seed, and the same clips kept from training as with the usual one; a refiner keeps its density's."""
    if seed == USUAL_SEED:
        return model
    recipe = replace(model.recipe, settings=replace(model.recipe.settings, seed=seed))
    return replace(model, recipe=recipe if "--density" in model.needs else replace(recipe, split=USUAL_SEED))
