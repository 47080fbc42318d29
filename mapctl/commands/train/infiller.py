"""`mapctl train infiller`: the options of an infiller."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from mapctl.commands.train.options import TunableOptions

if TYPE_CHECKING:
    from priors.training.recipes.infiller import InfillerRecipe

_Architectures = Literal["skips", "image"]


@dataclass(frozen=True)
class TrainInfiller(TunableOptions):
    """Train an infiller, which infill, tween, blend and chain begin with if it is named."""

    model = "infiller"
    used_by = "use it with --method infiller --inbetweener"

    architecture: Annotated[_Architectures | None, arg(metavar="skips|image")] = None
    """skips is ours, image the paper's."""

    def recipe(self) -> "InfillerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.infiller import InfillerConfig, InfillerRecipe, InfillerSettings

        common = self.common()
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        return InfillerRecipe(
            **common,
            config=replace(InfillerConfig(), **self.select_given("architecture")),
            settings=replace(InfillerSettings(), bfloat16=self.bfloat16, **given),
            skip_first=self.skip_first,
            init=self.init,
        )
