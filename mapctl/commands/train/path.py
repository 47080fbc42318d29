"""`mapctl train path`: the options of a path predictor."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mapctl.commands.shared import options
from mapctl.commands.train.options import TunableOptions

if TYPE_CHECKING:
    from priors.training.recipes.path import PathRecipe


@dataclass(frozen=True)
class TrainPath(TunableOptions):
    """Train a path predictor, which tells where the hips go from how the body moves about them."""

    model = "path"
    used_by = "use it with mapctl infill --way A:B --path"

    width: options.MaybeCount = None
    """Channels of the outer layers; the inner ones have twice as many."""

    def recipe(self) -> "PathRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.path import PathConfig, PathRecipe, PathSettings

        common = self.common()
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        return PathRecipe(
            **common,
            config=replace(PathConfig(), **self.select_given("width")),
            settings=replace(PathSettings(), bfloat16=self.bfloat16, **given),
            skip_first=self.skip_first,
            init=self.init,
        )
