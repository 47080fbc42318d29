"""`mapctl train`: a model from a folder of BVH. One class of options a model; its recipe is in
`priors.training.recipes`.
"""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import reduce
from importlib import import_module
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

from tyro.conf import arg, subcommand

from mapctl.commands.shared import options
from mapctl.commands.shared.command import use_single_thread
from mapctl.errors import CheckpointError, RequestError, WriteError

if TYPE_CHECKING:
    from priors.training.loop import Recipe


@dataclass(frozen=True)
class TrainOptions:
    """Options of `train` for any model. They are named as the fields of its recipe, settings and network are."""

    model: ClassVar[str]
    """Kind of model, as the command line calls it."""
    recipe_class: ClassVar[str]
    """Module and class of its recipe."""
    used_by: ClassVar[str]
    """How commands take what was trained."""
    single_thread: ClassVar[bool] = True
    """Whether training is fastest on one."""

    data: options.DataFolder
    """Folder of .bvh files, searched with everything below it."""
    out: options.OutFolder
    """Run folder: checkpoint, losses, and at the end model.safetensors with its card."""
    match: Annotated[str | None, arg(metavar="REGEX")] = None
    """Only clips whose path below the data folder holds this regular expression."""
    cuts: options.MaybeFile = None
    """Table (CSV) of file, first and last frame: which frames are motion (`*,1,` leaves out frame 0 of all); `cmu` is
    the one for takes of CMU that comes with mapctl. Each Frame_Cuts.csv in the data folder is found by itself
    (docs/guides/data.md)."""
    level: bool = False
    """Put every clip on the canonical body and a level floor: for captures whose floor slopes or whose feet rest at
    other heights, as those of CMU."""
    steps: options.MaybeCount = None
    """Steps in all."""
    seed: options.MaybeCount = None
    """Seed of weights, windows, noise and the split of the clips."""
    patience: options.Count = 0
    """End training after so many validations without a better one, with the best weights; 0 takes all steps."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    licence: Annotated[str | None, arg(metavar="TEXT")] = None
    """Licence of the weights, for their card; if not given, `that of the training data`."""
    quiet: bool = False
    """No lines of news."""

    def run(self) -> int:
        """Check, train, name the result."""
        recipe = self.recipe()
        if self.single_thread:
            use_single_thread()
        from priors.training import loop

        with self._explain_end():
            path = loop.train(recipe, _ignore if self.quiet else _print, warn=_warn)
        if not self.quiet:
            print(f"wrote {path}; {self.used_by} {self.out}")
        return 0

    def recipe(self) -> "Recipe[Any, Any, Any]":
        """Return the recipe with these options; RequestError for numbers that make no sense."""
        if self.seed is not None:
            options.check_seed(self.seed)
        module, name = self.recipe_class.split(":")
        kind = getattr(import_module(f"priors.training.recipes.{module}"), name)
        given = {name: value for name, value in self.collect().items() if value is not None}
        own = {field.name: field for field in fields(kind)}
        parts = {name: cast(Any, own[name].default_factory)() for name in ("config", "settings")}
        if given.pop("paper", False):
            parts["config"] = import_module(type(parts["config"]).__module__).PAPER
        for part, usual in parts.items():
            named = {field.name for field in fields(usual)} - {*own}
            parts[part] = replace(usual, **{name: value for name, value in given.items() if name in named})
        return kind(**{name: value for name, value in given.items() if name in own}, **parts)

    def collect(self) -> dict[str, Any]:
        """Collect the options by the names of the recipe's fields, its settings' and its network's; None is not
        given."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @contextmanager
    def _explain_end(self) -> Iterator[None]:
        """Add to the message of Ctrl-C, SIGTERM or a full disk which step is saved, and what to type."""
        try:
            yield
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(self._describe_saved() or "nothing was saved yet") from stop
        except WriteError as error:
            raise WriteError("; ".join(filter(None, (str(error), self._describe_saved())))) from error

    def _describe_saved(self) -> str:
        from priors.training.loop import read_index

        try:
            step = read_index(self.out)["step"]
        except CheckpointError:
            return ""
        return f"step {step} is saved; the same command with --resume goes on"


@dataclass(frozen=True)
class NetworkOptions(TrainOptions):
    """Options of any network that learns from windows of clips."""

    batch: options.MaybeCount = None
    """Windows a step."""
    window: options.MaybeCount = None
    """Frames a window."""
    bfloat16: bool = False
    """Let the network compute in bfloat16: faster on a processor or GPU that has it."""


@dataclass(frozen=True)
class TunableOptions(NetworkOptions):
    """Options of any network that may start from another network's weights."""

    learning_rate: options.MaybeNumber = None
    """At its highest; 0.001 from scratch, less to fine-tune."""
    init: Annotated[str | None, arg(metavar="NAME")] = None
    """Begin with the weights of this model, bundled or trained, and fine-tune them."""
    init_share: options.MaybeNumber = None
    """Share of the weights of --init in the ones that are written, the rest being the fine-tuned ones': 0.7 keeps most
    of what the initial model knew (Wortsman et al. 2022)."""
    device: Annotated[Literal["auto", "cpu", "cuda"], arg(metavar="auto|cpu|cuda")] = "auto"
    """Where to compute; auto is a GPU with CUDA where there is one."""


@dataclass(frozen=True)
class TrainDensity(TunableOptions):
    """Train the density that follow, generate, steer and others use as their prior."""

    model = "lstm-gmm"
    recipe_class = "lstm_gmm:DensityRecipe"
    used_by = "use it with --prior"
    single_thread = False

    width: options.MaybeCount = None
    """Units of every hidden layer."""
    components: options.MaybeCount = None
    """Gaussians in the mixture."""
    paper: bool = False
    """The network of Wang et al. 2019; other options still hold."""
    labels: Annotated[str, arg(metavar="REGEX")] = ""
    """Named groups read labels from the clips' paths, as in '_(?P<gait>walk|run)_(?P<style>[a-z]+)_', for --style."""
    label_pace: bool = False
    """Make the pace a label as well: stand, walk or run, by how a window of training ends. Random motion is then given
    one pace after another, as often as the clips change theirs."""
    copies: options.Count = 0
    """Copies of each clip at other tempos and with other strides that training sees beside it: for a few minutes of
    motion (docs/guides/data.md)."""
    tempo: options.Number = 0.15
    """Largest change of a copy's tempo, as a share."""
    strides: options.Number = 0.1
    """Largest change of how far a copy steps, as a share: as of a body with other legs."""
    splices: options.Count = 0
    """Splices of the clips that are tried: pieces of two and the stitcher's motion between them, for starts, stops and
    changes that single clips lack. Those that pass for mocap are trained on as well."""
    stitcher: options.MaybeName = None
    """Stitcher for the splices; the bundled one if not given."""
    critic_steps: options.Count = 0
    """Last steps in which a critic joins that separates a second of a free run from captured motion, and the density is
    trained to pass as well; what is kept is then the running mean of the weights."""
    standing_share: options.MaybeNumber = None
    """Share of the windows of standing characters that training sees, 1 by default: below it for motion that mostly
    stands, whose density is hard to steer into a walk otherwise."""

    def collect(self) -> dict[str, Any]:
        """Collect the options; RequestError for those of the network where it is another prior's."""
        if self.init is not None and (self.paper or self.width is not None or self.components is not None):
            raise RequestError(
                "with --init the network is that prior's; --width, --components and --paper do not apply"
            )
        return super().collect()


@dataclass(frozen=True)
class TrainRefiner(NetworkOptions):
    """Train a refiner, which makes a density's samples look captured; a step is a round of updates of the refiner and
    its critic."""

    model = "refiner"
    recipe_class = "refiner:RefinerRecipe"
    used_by = "use it with --refiner"

    match: Annotated[str | None, arg(metavar="REGEX")] = None
    """Only clips whose path below the data folder holds this regular expression; by default the clips that the density
    was trained on."""
    density: options.Name = "locomotion"
    """The prior whose samples it refines."""
    paper: bool = False
    """The network of Wang et al. 2019; other options still hold."""


@dataclass(frozen=True)
class TrainDenoiser(TunableOptions):
    """Train the denoiser that denoise begins with."""

    model = "denoiser"
    recipe_class = "denoiser:DenoiserRecipe"
    used_by = "use it with --denoiser"

    width: options.MaybeCount = None
    """Channels of every layer."""
    angles: options.MaybeNumber = None
    """Weight of the error of joint angles (radians) in the loss, beside the centimetres of positions; 20 if not
    given."""


@dataclass(frozen=True)
class TrainPoseTransformer(TunableOptions):
    """Train the pose transformer that infill, tween, blend and chain begin with; --batch is in frames."""

    model = "pose-transformer"
    recipe_class = "pose_transformer:PoseTransformerRecipe"
    used_by = "use it with --inbetweener"

    width: options.MaybeCount = None
    """Numbers of a frame's token, even; every 32 of them have a head of attention."""
    layers: options.MaybeCount = None
    """Layers of attention."""
    detail: options.MaybeCount = None
    """Layers of a second stage, which corrects what the first proposes; the first then looks at frames alone in which
    something is known."""

    def collect(self) -> dict[str, Any]:
        """Collect the options; the width decides the number of heads."""
        return {**super().collect(), "heads": None if self.width is None else max(1, self.width // 32)}


@dataclass(frozen=True)
class TrainInfiller(TunableOptions):
    """Train an infiller, which infill, tween, blend and chain begin with if it is named."""

    model = "infiller"
    recipe_class = "infiller:InfillerRecipe"
    used_by = "use it with --method infiller --inbetweener"

    architecture: Annotated[Literal["skips", "image"] | None, arg(metavar="skips|image")] = None
    """skips is ours, image that of Kaufmann et al. 2020."""


@dataclass(frozen=True)
class TrainKeyframeTiming(TrainOptions):
    """Fit how long people take from one pose to the next, which tween suggests; a step reweights the least squares."""

    model = "keyframe-timing"
    recipe_class = "keyframe_timing:KeyframeTimingRecipe"
    used_by = "use it with mapctl tween --suggest-timing --timing"

    pairs: options.MaybeCount = None
    """Pairs of poses drawn of every clip."""


@dataclass(frozen=True)
class TrainPath(TunableOptions):
    """Train a path predictor, which predicts the root trajectory from how the body moves about the hips."""

    model = "path"
    recipe_class = "path:PathRecipe"
    used_by = "use it with mapctl infill --way A:B --path"

    width: options.MaybeCount = None
    """Channels of the outer layers; the inner ones have twice as many."""


@dataclass(frozen=True)
class TrainTweener(TunableOptions):
    """Train a tweener, which generates motion between keys that are seconds apart."""

    model = "tweener"
    recipe_class = "tweener:TweenerRecipe"
    used_by = "use it with mapctl tween --method tweener --inbetweener"

    path: options.MaybeName = None
    """Path predictor, bundled or trained, for the root trajectory of what is generated; the bundled one if not
    given."""
    paper: bool = False
    """The network of Zhou et al. 2020; other options still hold."""
    labels: Annotated[str | None, arg(metavar="REGEX")] = None
    """Class of a clip by its path below the data folder, for `mapctl tween --dna NAME`: what the first group matches;
    if not given, Bandai Namco's content, else the folder or the file's name without a number."""


@dataclass(frozen=True)
class TrainStitcher(TunableOptions):
    """Train the stitcher, which generates many motions from one pose to another; --batch is in transitions, --window in
    frames of the longest."""

    model = "stitcher"
    recipe_class = "stitcher:StitcherRecipe"
    used_by = "use it with --stitcher"


KINDS: Mapping[str, type[TrainOptions]] = {
    kind.model: kind
    for kind in (
        TrainDensity,
        TrainRefiner,
        TrainDenoiser,
        TrainPoseTransformer,
        TrainInfiller,
        TrainKeyframeTiming,
        TrainPath,
        TrainTweener,
        TrainStitcher,
    )
}
"""What `mapctl train` takes, by its name."""

if TYPE_CHECKING:
    AnyModel = TrainOptions
else:
    AnyModel = reduce(or_, (Annotated[kind, subcommand(name, prefix_name=False)] for name, kind in KINDS.items()))


@dataclass(frozen=True)
class Train:
    """Train a model on a folder of BVH; an interrupted run goes on from its last checkpoint."""

    model: AnyModel
    """What to train."""

    def run(self) -> int:
        """Train it."""
        return self.model.run()


def _print(line: str) -> None:
    """Print a line at once, so that a log file shows how far a run of hours has come."""
    print(line, flush=True)


def _warn(line: str) -> None:
    """Print a line where --quiet and redirected output do not hide it."""
    print(f"mapctl: {line}", file=sys.stderr, flush=True)


def _ignore(line: str) -> None:
    """Take a line of news, and do nothing with it."""
