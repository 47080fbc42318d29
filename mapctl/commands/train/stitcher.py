"""`mapctl train stitcher`: the options of a stitcher."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from mapctl.commands.train.options import TunableOptions

if TYPE_CHECKING:
    from priors.training.recipes.stitcher import StitcherRecipe


@dataclass(frozen=True)
class TrainStitcher(TunableOptions):
    """Train the stitcher, which makes many motions from one pose to another; --batch is in transitions, --window the
    frames of their longest."""

    model = "stitcher"
    used_by = "use it with --stitcher"

    paper: bool = False
    """Scheme, losses and batches as the paper prints them, at our widths (the printed ones have eight times the
    weights); other options still hold."""
    without: Literal["d"] | None = None
    """`d` leaves out the critics, whose judgement is one of the losses else (Ren et al. 2024, table 6)."""

    def recipe(self) -> "StitcherRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.stitcher import PAPER, StitcherConfig, StitcherRecipe, StitcherSettings

        common = self.common()
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        config, settings = PAPER if self.paper else (StitcherConfig(), StitcherSettings())
        settings = replace(settings, bfloat16=self.bfloat16, **given)
        return StitcherRecipe(
            **common,
            config=replace(config, without=("d",) if self.without else ()),
            settings=settings,
            skip_first=self.skip_first,
            init=self.init,
        )
