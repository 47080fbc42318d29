"""`mapctl train tweener`: the options of the generator of long in-betweens."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.train.options import ParallelOptions

if TYPE_CHECKING:
    from priors.training.recipes.tweener import TweenerRecipe


@dataclass(frozen=True)
class TrainTweener(ParallelOptions):
    """Train a tweener, which makes motion between keys that are seconds apart."""

    model = "tweener"
    used_by = "use it with mapctl tween --method tweener --inbetweener"

    path: Annotated[str, arg(metavar="NAME")] = "path"
    """Path predictor, bundled or trained, that tells where the hips go in what is made."""
    plain: bool = False
    """The network without the connections past its narrow middle, as in the paper, to compare."""

    def recipe(self) -> "TweenerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.tweener import GeneratorConfig, TweenerRecipe, TweenerSettings

        common = self.common()
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        return TweenerRecipe(
            **common,
            config=replace(GeneratorConfig(), skips=not self.plain),
            settings=replace(TweenerSettings(), bfloat16=self.bfloat16, **given),
            skip_first=self.skip_first,
            init=self.init,
            processes=self.processes,
            path=self.path,
        )
