"""What each model that comes with mapctl is trained with: one table, by which `mapctl train all` makes them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mapctl.errors import RequestError
from priors.lstm_gmm.network import LstmGmmConfig
from priors.pose_transformer.network import PoseTransformerConfig
from priors.stitching.network import StitcherConfig
from priors.training.augmentation.clip_copies import ClipCopies
from priors.training.augmentation.splices import Splices
from priors.training.ending.course import UntilFlat
from priors.training.mocap.cuts import CMU
from priors.training.recipe import Recipe
from priors.training.recipes.denoiser import DenoiserRecipe, DenoiserSettings
from priors.training.recipes.density.critic import CriticSettings
from priors.training.recipes.density.settings import TrainingSettings
from priors.training.recipes.infiller import InfillerRecipe
from priors.training.recipes.keyframe_timing import KeyframeTimingRecipe
from priors.training.recipes.lstm_gmm import DensityRecipe
from priors.training.recipes.path import PathRecipe, PathSettings
from priors.training.recipes.pose_transformer import PoseTransformerRecipe, PoseTransformerSettings
from priors.training.recipes.refiner import AdversarialSettings, RefinerRecipe
from priors.training.recipes.stitcher import StitcherRecipe, StitcherSettings
from priors.training.recipes.tweener import TweenerRecipe, TweenerSettings

DATA, RUN, MADE = Path("DATA"), Path("RUN"), Path("MADE")
"""What a card's command calls the folders of clips, of the run, and of clips that a model made."""
USUAL_SEED = 1
"""Seed by which clips are kept from training, whatever the seed of all else."""
AnyRecipe = Recipe[Any, Any, Any]


@dataclass(frozen=True)
class WeightSet:
    """A set of models: its clips, the licence of its weights, and what depends on how much motion there is."""

    licence: str
    """Of the weights, if all of them have seen is the set's own clips."""
    own: str
    """Regular expression for the paths of these, by which alone they are known."""
    match: str = ""
    """Regular expression for the paths of all clips below the data folder."""
    locomotion: str = ""
    """The same for those of walks and runs."""
    labels: str = ""
    """Regular expression whose groups read gait and style from them; nothing where names do not tell."""
    level: bool = False
    """Put every clip on the canonical body and a level floor, where a model does not have to know captures as they
    come."""
    copies: int = 0
    """Copies of each clip, at other tempos and with other strides, that the densities are trained on beside it."""
    standing_share: float = 1.0
    """Share of the windows in which nobody goes anywhere that the densities of walks and runs are shown."""
    critic_steps: int = 0
    """Last steps of the density of walks and runs, besides the planned ones, in which a critic judges its free runs."""
    splices: int = 0
    """Splices of the clips that are tried for the density of everyday motion; with some, the pace is a label of it."""
    everyday_steps: int = 8000
    """Steps of the density of everyday motion."""
    everyday_standing_share: float = 1.0
    """Share of the windows in which nobody goes anywhere that the density of everyday motion is shown."""
    window: int = TrainingSettings.window
    """Frames of the windows of densities: short ones where runs are short."""
    width: int = 256
    """Of the densities' networks."""
    live_width: int | None = 160
    """Of the network of the density for live control; None where that of walks and runs serves. Trained on a few
    minutes, networks of 120, 160 and 256 lost their way along some curves."""
    angles: float = DenoiserSettings.angles
    """Weight of the error of joint angles in the denoiser's loss."""
    share: float = 1.0
    """Planned steps, as a share of those for hours of motion: curves of small sets are flat sooner."""

    def plan(self, steps: int) -> int:
        """Planned steps of a model that hours of motion would take so many."""
        return round(self.share * steps)


SETS: Mapping[str, WeightSet] = {
    "full": WeightSet(
        licence="CC BY-NC 4.0",
        own=r"(^|/)dataset-[12]_|^cmu/",
        locomotion="dataset-2_(walk|walk-turn-left|walk-turn-right|run)_",
        labels="_(?P<gait>run|walk|walk-turn-left|walk-turn-right)_(?P<style>[a-z]+)_",
        critic_steps=1500,
        splices=3500,
        everyday_standing_share=0.5,
    ),
    "free": WeightSet(
        licence="free for any use",
        own=r"^cmu/",
        match=r"^cmu(?!.*/(01_14|05_(0[568]|1[04-9])|07_12|09_10|14_36)\.)",  # faulty (docs/guides/data.md)
        locomotion=r"^cmu.*/(02_(0[1-36]|10)|05_01|06_(0\d|1[0-2])|07_(0\d|1[01])|08_\d\d|09_(0[1-69]|1[12])|10_0\d|11_01"
        r"|13_(0[7-9]|1[4-6]|26)|14_(0[45]|1[27-9]|37))\.",
        level=True,
        copies=8,
        standing_share=0.33,
        everyday_steps=4800,
        window=40,
        width=192,
        live_width=None,
        angles=10.0,
        share=0.4,
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


def list_models(
    weights: str = "full",
    *,
    match: str | None = None,
    seed: int = USUAL_SEED,
    share: float = 1.0,
    with_made: bool = False,
) -> tuple[BundledModel, ...]:
    """List the models of a set, each after those that it needs.

    `match` chooses clips of one's own for the densities of walks and runs, without labels, `share` is that of the clips
    that are trained on, and `with_made` has those densities see clips that a model made as well. RequestError for a set
    that does not exist.
    """
    if weights not in SETS:
        raise RequestError(f"the weights are {' or '.join(SETS)}, got {weights!r}")
    chosen = SETS[weights] if match is None else replace(SETS[weights], locomotion=match, labels="")
    models = (_seed(model, seed) for model in _make_models(chosen, MADE if with_made else None))
    return tuple(replace(model, recipe=replace(model.recipe, data_share=share)) for model in models)


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


def _make_models(weights: WeightSet, made: Path | None) -> tuple[BundledModel, ...]:
    """The table. Steps are a plan, where a run goes on until its curve is flat. Those of densities are told: a curve of
    likelihoods goes on falling while free runs already drift off (docs/guides/training.md)."""
    captures: dict[str, Any] = {"data": DATA, "out": RUN, "licence": weights.licence, "cuts": CMU}
    shared: dict[str, Any] = {**captures, "level": weights.level}
    until_flat: dict[str, Any] = {"match": weights.match or None, "until_flat": UntilFlat()}
    everything = {**shared, **until_flat}
    general = {**shared, "match": weights.match}  # which a density's command always tells
    walks: dict[str, Any] = {**general, "match": weights.locomotion, "labels": weights.labels, "made": made}
    stitcher = BundledModel(
        "stitcher",
        StitcherRecipe(
            **everything,
            config=StitcherConfig(without=("d",)),
            settings=StitcherSettings(steps=weights.plan(3000), batch=256, learning_rate=0.002, bfloat16=True),
        ),
    )
    return (
        *_make_densities_of_walks(weights, walks),
        stitcher,
        BundledModel(
            "general",
            DensityRecipe(
                **general,
                **_density(weights, weights.width, weights.everyday_steps, weights.everyday_standing_share),
                label_pace=weights.splices > 0,
                splices=Splices(weights.splices),
            ),
            needs={"--stitcher": "stitcher"} if weights.splices else {},
        ),
        BundledModel(
            "locomotion-refiner",
            RefinerRecipe(**shared, settings=AdversarialSettings(rounds=weights.plan(3000), bfloat16=True)),
            needs={"--density": "locomotion"},
        ),
        BundledModel("path", PathRecipe(**everything, settings=PathSettings(steps=weights.plan(PathSettings.steps)))),
        BundledModel(
            "tweener",
            TweenerRecipe(**everything, settings=TweenerSettings(steps=weights.plan(TweenerSettings.steps))),
            needs={"--path": "path"},
        ),
        BundledModel(
            "transformer",
            PoseTransformerRecipe(
                **everything,
                config=PoseTransformerConfig(width=192, layers=3, heads=6, detail=3),
                settings=PoseTransformerSettings(steps=weights.plan(PoseTransformerSettings.steps), bfloat16=True),
            ),
        ),
        # floors and bodies as captures have them are part of what it takes the noise from
        BundledModel(
            "denoiser",
            DenoiserRecipe(
                **captures,
                **until_flat,
                settings=DenoiserSettings(
                    steps=weights.plan(DenoiserSettings.steps), angles=weights.angles, bfloat16=True
                ),
            ),
        ),
        BundledModel("keyframe-timing", KeyframeTimingRecipe(**shared, match=weights.match or None)),
    )


def _make_densities_of_walks(weights: WeightSet, walks: dict[str, Any]) -> list[BundledModel]:
    """That for everything, and a smaller one for live control where the set has one."""
    models = []
    for name, width, critic_steps in (
        ("locomotion", weights.width, weights.critic_steps),
        ("locomotion-live", weights.live_width, 0),
    ):
        if width is not None:
            steps = weights.plan(10_000) + critic_steps
            density = _density(weights, width, steps, weights.standing_share, critic_steps)
            models.append(BundledModel(name, DensityRecipe(**walks, **density)))
    return models


def _density(
    weights: WeightSet, width: int, steps: int, standing_share: float, critic_steps: int = 0
) -> dict[str, Any]:
    settings = TrainingSettings(
        steps=steps,
        batch=64,
        window=weights.window,
        bfloat16=True,
        copies=ClipCopies(weights.copies),
        standing_share=standing_share,
        critic=CriticSettings(critic_steps),
    )
    return {"config": LstmGmmConfig(width=width), "settings": settings}


def _seed(model: BundledModel, seed: int) -> BundledModel:
    """With another seed, and the same clips kept from training as with the usual one; a refiner keeps its density's."""
    if seed == USUAL_SEED:
        return model
    recipe = replace(model.recipe, settings=replace(model.recipe.settings, seed=seed))
    return replace(model, recipe=recipe if "--density" in model.needs else replace(recipe, split=USUAL_SEED))
