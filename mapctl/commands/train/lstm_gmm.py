"""`mapctl train lstm-gmm`: the options of a density."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.train.options import TunableOptions
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipes.lstm_gmm import DensityRecipe


@dataclass(frozen=True)
class TrainDensity(TunableOptions):
    """Train the density that follow, generate, steer and others use as their prior."""

    model = "lstm-gmm"
    used_by = "use it with --prior"
    single_thread = False

    width: options.MaybeCount = None
    """Units of every hidden layer."""
    components: options.MaybeCount = None
    """Gaussians in the mixture."""
    paper: bool = False
    """The paper's own network and recipe instead of the measured better one; other options still hold."""
    plain: bool = False
    """The plainest network of the kind, to compare: one Gaussian a frame with independent values, one level of noise on
    the input that it is not told, no free runs held to the data."""
    labels: Annotated[str, arg(metavar="REGEX")] = ""
    """Named groups read labels from the clips' paths, as in '_(?P<gait>walk|run)_(?P<style>[a-z]+)_', for --style."""
    label_pace: bool = False
    """Make the pace a label as well: stand, walk or run, by how a window of training ends. Random motion
    is then told them one after the other, as often as the clips change theirs."""
    made: options.MaybeDataFolder = None
    """Folder of clips that mapctl make has made, to train on as well: starts, stops and turns that the data lack. None
    of them is held out."""
    copies: options.Count = 0
    """Copies of each clip at other tempos and with other strides that training sees beside it: for a few minutes of
    motion (docs/guides/data.md)."""
    tempo: options.Number = 0.15
    """Largest change of a copy's tempo, as a share."""
    strides: options.Number = 0.1
    """Largest change of how far a copy steps, as a share: as of a body with other legs."""
    splices: options.Count = 0
    """Splices of the clips that are tried: pieces of two and the stitcher's way between them, so that who does one
    thing sets off, stops or does another. Those that pass for mocap are trained on as well."""
    stitcher: options.MaybeName = None
    """Stitcher that makes them; the bundled one if not given."""
    critic_steps: options.Count = 0
    """Last steps in which a critic joins that tells a second of a free run from captured motion, and the density is
    made to pass as well; what is kept is then the running mean of the weights."""
    standing_share: options.MaybeNumber = None
    """Share of the windows in which nobody goes anywhere that training sees, 1 by default: below it for motion that
    mostly stands, whose density stands fast otherwise."""

    def recipe(self) -> "DensityRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.lstm_gmm.network import LstmGmmConfig
        from priors.training.augmentation.clip_copies import ClipCopies
        from priors.training.augmentation.splices import Splices
        from priors.training.recipes.density.settings import PAPER, PLAIN, TrainingSettings
        from priors.training.recipes.lstm_gmm import DensityRecipe

        common, shape = self.common(), self.select_given("width", "components")
        if self.init is not None and (self.paper or self.plain or shape):
            raise RequestError(
                "with --init the network is that prior's; --width, --components, --paper and --plain do not apply"
            )
        if self.paper and self.plain:
            raise RequestError("--paper and --plain are two variants; choose one")
        if self.stitcher is not None and self.splices == 0:
            raise RequestError("--stitcher makes --splices N of the clips; tell how many, or leave it out")
        copies = ClipCopies(self.copies, tempo=self.tempo, strides=self.strides)
        usual = (LstmGmmConfig(), TrainingSettings())
        config, settings = PAPER if self.paper else PLAIN if self.plain else usual
        given = self.select_given("steps", "batch", "window", "learning_rate", "standing_share", "seed")
        return DensityRecipe(
            **common,
            config=replace(config, **shape),
            settings=replace(
                settings,
                bfloat16=self.bfloat16,
                copies=copies,
                critic=replace(settings.critic, steps=self.critic_steps),
                **given,
            ),
            skip_first=self.skip_first,
            made=self.made,
            splices=Splices(self.splices, self.stitcher or Splices.stitcher),
            labels=self.labels,
            label_pace=self.label_pace,
            init=self.init,
        )
