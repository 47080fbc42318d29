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

    def recipe(self) -> "TweenerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.tweener import TweenerRecipe, TweenerSettings

        common = self.common()
        given = self.select_given("steps", "batch", "seed", "learning_rate")
        if self.window is not None:
            from mapctl.errors import RequestError

            raise RequestError("a tweener's windows are as long as their keys are apart: it takes no --window")
        return TweenerRecipe(
            **common,
            settings=replace(TweenerSettings(), bfloat16=self.bfloat16, **given),
            skip_first=self.skip_first,
            init=self.init,
            processes=self.processes,
            path=self.path,
        )
