"""`mapctl train keyframe-timing`: the options of a timing of keyframes."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mapctl.commands.shared import options
from mapctl.commands.train.options import TrainOptions

if TYPE_CHECKING:
    from priors.training.recipes.keyframe_timing import KeyframeTimingRecipe


@dataclass(frozen=True)
class TrainKeyframeTiming(TrainOptions):
    """Fit how long people take from one pose to the next, which tween suggests."""

    model = "keyframe-timing"
    used_by = "use it with mapctl tween --suggest-timing --timing"

    steps: options.MaybeCount = None
    """Reweightings of the least squares."""
    pairs: options.MaybeCount = None
    """Pairs of poses drawn of every clip."""
    skip_first: bool = False
    """Leave out frame 0 of every clip (the T-pose of CMU takes)."""

    def recipe(self) -> "KeyframeTimingRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.keyframe_timing import KeyframeTimingRecipe, KeyframeTimingSettings

        settings = replace(KeyframeTimingSettings(), **self.select_given("steps", "pairs", "seed"))
        return KeyframeTimingRecipe(**self.common(), settings=settings, skip_first=self.skip_first)
