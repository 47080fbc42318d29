"""`mapctl train refiner`: the options of a refiner."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.train.options import NetworkOptions
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipes.refiner import RefinerRecipe
    from priors.training.recipes.refining.plain import PlainRefinerRecipe


@dataclass(frozen=True)
class TrainRefiner(NetworkOptions):
    """Train a refiner, which makes a density's samples look captured."""

    model = "refiner"
    used_by = "use it with --refiner"

    match: Annotated[str | None, arg(metavar="REGEX")] = None
    """Only clips whose path below the data folder holds this regular expression; by default the clips that the density
    was trained on."""
    steps: options.MaybeCount = None
    """Rounds of some updates of the refiner and of its critic."""
    density: options.Name = "locomotion"
    """The prior whose samples it refines."""
    paper: bool = False
    """The paper's own network and recipe instead of the measured better one; other options still hold."""
    plain: bool = False
    """The plainest training of the kind, to compare: the same network without a critic, held to the feet, jerk and
    spread of captured windows and to the hips' way alone."""
    skip_first: bool = False
    """Leave out frame 0 of every clip (the T-pose of CMU takes)."""

    def recipe(self) -> "RefinerRecipe | PlainRefinerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.refiner import PAPER, AdversarialSettings, RefinerConfig, RefinerRecipe
        from priors.training.recipes.refining.plain import PlainRefinerRecipe, PlainRefinerSettings

        if self.paper and self.plain:
            raise RequestError("--paper and --plain are two variants; choose one")
        shared = {**self.common(), "density": self.density, "skip_first": self.skip_first}
        given = {"bfloat16": self.bfloat16, **self.select_given("batch", "window", "seed", rounds="steps")}
        if self.plain:
            return PlainRefinerRecipe(**shared, settings=PlainRefinerSettings(**given))
        config, settings = PAPER if self.paper else (RefinerConfig(), AdversarialSettings())
        return RefinerRecipe(**shared, config=config, settings=replace(settings, **given))
