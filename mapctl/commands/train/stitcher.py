"""`mapctl train stitcher`: the options of a stitcher."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

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
    without: str = ""
    """Parts of Ren et al. 2024, table 6, to leave out, with commas between: bs (bi-directional scheme), sl (stitching
    loss), li (latent interpolation), ba (bi-directional aligning), pm (phase modulation), d (critics), lstm (the
    encoder's)."""

    def recipe(self) -> "StitcherRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.stitcher import PAPER, StitcherConfig, StitcherRecipe, StitcherSettings

        common = self.common()
        parts = tuple(part.strip() for part in self.without.split(",") if part.strip())
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        config, settings = PAPER if self.paper else (StitcherConfig(), StitcherSettings())
        settings = replace(settings, bfloat16=self.bfloat16, **given)
        if "sl" in parts:
            settings = replace(settings, weights=replace(settings.weights, stitching=0.0))
        return StitcherRecipe(
            **common,
            config=replace(config, without=parts),
            settings=settings,
            skip_first=self.skip_first,
            init=self.init,
        )
