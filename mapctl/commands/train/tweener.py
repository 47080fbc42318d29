"""`mapctl train tweener`: the options of the generator of long in-betweens."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.train.options import ParallelOptions
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipes.tweener import TweenerRecipe


@dataclass(frozen=True)
class TrainTweener(ParallelOptions):
    """Train a tweener, which makes motion between keys that are seconds apart."""

    model = "tweener"
    used_by = "use it with mapctl tween --method tweener --inbetweener"

    path: Annotated[str, arg(metavar="NAME")] = "path"
    """Path predictor, bundled or trained, that tells where the hips go in what is made."""
    critic_from: Annotated[str, arg(metavar="STEP|never")] = "never"
    """Step at which a critic joins, which tells made motion from captured; the best weights of all are exported."""
    plain: bool = False
    """The network without the connections past its narrow middle, as in the paper, to compare."""

    def recipe(self) -> "TweenerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.tweener import GeneratorConfig, TweenerRecipe, TweenerSettings

        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        everything = {
            **self.common(),
            "config": replace(GeneratorConfig(), skips=not self.plain),
            "settings": (settings := replace(TweenerSettings(), bfloat16=self.bfloat16, **given)),
            "skip_first": self.skip_first,
            "init": self.init,
            "processes": self.processes,
            "path": self.path,
        }
        if self.critic_from == "never":
            return TweenerRecipe(**everything)
        from priors.training.recipes.tweener_critic import CriticisedTweenerRecipe, CriticSettings

        begin = _parse_step(self.critic_from, settings.steps)
        return CriticisedTweenerRecipe(**everything, critic=CriticSettings(begin))


def _parse_step(text: str, steps: int) -> int:
    if not text.isdecimal():
        raise RequestError(f"--critic-from is a step or never, got {text!r}")
    if int(text) >= steps:
        raise RequestError(f"--critic-from must be one of the {steps} steps from 0 on, got {text}")
    return int(text)
