"""`mapctl train tweener`: the options of the generator of long in-betweens."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.train.options import TunableOptions
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipes.tweener import TweenerRecipe


@dataclass(frozen=True)
class TrainTweener(TunableOptions):
    """Train a tweener, which makes motion between keys that are seconds apart."""

    model = "tweener"
    used_by = "use it with mapctl tween --method tweener --inbetweener"

    path: Annotated[str, arg(metavar="NAME")] = "path"
    """Path predictor, bundled or trained, that tells where the hips go in what is made."""
    critic_from: Annotated[str | None, arg(metavar="STEP|never")] = None
    """Step at which a critic joins, which tells made motion from captured; the best weights of all are exported. never,
    unless --paper is given."""
    paper: bool = False
    """Sizes, losses and optimiser as the paper prints them; other options still hold."""
    labels: Annotated[str | None, arg(metavar="REGEX")] = None
    """Class of a clip by its path below the data folder, for `mapctl tween --dna NAME`: what the first group matches;
    if not given, Bandai Namco's content, else the folder or the file's name without a number."""
    plain: bool = False
    """The network without the connections past its narrow middle, as in the paper, to compare."""

    def recipe(self) -> "TweenerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.tweener import PAPER, GeneratorConfig, TweenerRecipe, TweenerSettings

        common = self.common()
        config, settings = PAPER if self.paper else (GeneratorConfig(), TweenerSettings())
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        settings = replace(settings, bfloat16=self.bfloat16, **given)
        skips = config.skips and not self.plain
        everything = {
            **common,
            "config": replace(config, skips=skips),
            "settings": settings,
            "skip_first": self.skip_first,
            "init": self.init,
            "path": self.path,
            **({} if self.labels is None else {"labels": self.labels}),
        }
        if self.until_flat and self.critic_from not in (None, "never"):
            raise RequestError("a critic joins a run of a known length: leave out --until-flat or --critic-from")
        critic_from = self.critic_from or ("0" if self.paper else "never")
        if critic_from == "never":
            return TweenerRecipe(**everything)
        from priors.training.recipes.tweener_critic import CriticisedTweenerRecipe, CriticSettings

        begin = _parse_step(critic_from, settings.steps)
        return CriticisedTweenerRecipe(**everything, critic=CriticSettings(begin))


def _parse_step(text: str, steps: int) -> int:
    if not text.isdecimal():
        raise RequestError(f"--critic-from is a step or never, got {text!r}")
    if int(text) >= steps:
        raise RequestError(f"--critic-from must be one of the {steps} steps from 0 on, got {text}")
    return int(text)
