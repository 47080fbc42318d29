"""`mapctl train denoiser`: the options of a denoiser."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mapctl.commands.shared import options
from mapctl.commands.train.options import TunableOptions
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipes.denoiser import DenoiserRecipe


@dataclass(frozen=True)
class TrainDenoiser(TunableOptions):
    """Train the denoiser that denoise begins with."""

    model = "denoiser"
    used_by = "use it with --denoiser"

    width: options.MaybeCount = None
    """Channels of every layer."""
    angles: options.MaybeNumber = None
    """Weight of the error of joint angles (radians) in the loss, beside the centimetres of places; 20 if not given."""

    def check(self) -> None:
        """RequestError for numbers that make no sense for a denoiser."""
        super().check()
        if self.angles is not None and not 0 <= self.angles <= 1000:
            raise RequestError(f"--angles must lie between 0 and 1000, got {self.angles:g}")

    def recipe(self) -> "DenoiserRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.denoiser import DenoiserConfig, DenoiserRecipe, DenoiserSettings

        common = self.common()
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate", "angles")
        return DenoiserRecipe(
            **common,
            config=replace(DenoiserConfig(), **self.select_given("width")),
            settings=replace(DenoiserSettings(), bfloat16=self.bfloat16, **given),
            skip_first=self.skip_first,
            init=self.init,
        )
