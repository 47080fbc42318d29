"""`mapctl train`: a prior from a folder of BVH."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.train import checks
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.lstm_gmm.network import LstmGmmConfig
    from priors.training.recipes.lstm_gmm import TrainingSettings
    from priors.training.run import DensityRequest


_Models = Literal["lstm-gmm", "refiner", "denoiser", "infiller"]
_Architectures = Literal["skips", "image", "vanilla", "manifold"]


@dataclass(frozen=True)
class Train:
    """Train a prior on a folder of BVH; interrupted or killed and resumed, a run gives the same weights."""

    model: Positional[Annotated[_Models, arg(metavar="lstm-gmm|refiner|denoiser|infiller")]]
    """What to train: lstm-gmm is the density that follow and generate use; refiner makes its samples look captured;
    denoiser is what denoise begins with, infiller what infill does."""
    data: options.DataFolder
    """Folder of .bvh files, searched with everything below it."""
    out: options.OutFolder
    """Run folder: checkpoints, training curve, and at the end model.safetensors with its card."""
    match: Annotated[str | None, arg(metavar="REGEX")] = None
    """Only clips whose path below the data folder holds this regular expression; of a refiner, by default the clips
    that its density was trained on."""
    density: options.Name = "locomotion"
    """Of a refiner: the prior whose samples it refines."""
    width: options.MaybeCount = None
    """Units of every hidden layer."""
    components: options.MaybeCount = None
    """Gaussians in the mixture."""
    steps: options.MaybeCount = None
    """Optimiser steps in all; of a refiner, rounds of some updates of it and one of its critic."""
    batch: options.MaybeCount = None
    """Windows a step."""
    window: options.MaybeCount = None
    """Frames a window."""
    learning_rate: options.MaybeNumber = None
    """At the start; 0.001 from scratch, less to fine-tune."""
    architecture: Annotated[_Architectures | None, arg(metavar="skips|image|vanilla|manifold")] = None
    """Of an infiller: skips is the bundled one's, image the paper's, vanilla and manifold its baselines."""
    paper: bool = False
    """The paper's own network and recipe instead of the measured better one; other options still hold."""
    labels: Annotated[str, arg(metavar="REGEX")] = ""
    """Named groups read labels from the clips' paths, as in '_(?P<gait>walk|run)_(?P<style>[a-z]+)_', for --style."""
    init: Annotated[str | None, arg(metavar="NAME")] = None
    """Begin with the weights of this prior, bundled or trained, and fine-tune them; the network is then its own."""
    bfloat16: bool = False
    """Let the network compute in bfloat16: faster where the processor has it."""
    seed: options.MaybeCount = None
    """Of weights, windows, noise and the split of the clips."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    device: Annotated[Literal["auto", "cpu", "cuda"], arg(metavar="auto|cpu|cuda")] = "auto"
    """Where to compute."""
    minutes_between_checkpoints: options.Number = 3.0
    """How much a kill may cost."""
    skip_first: bool = False
    """Leave out frame 0 of every clip (the T-pose of CMU takes)."""
    strict_data: bool = False
    """Refuse a folder with a file that cannot be used; if not given, such files are left out and listed."""
    licence: Annotated[str, arg(metavar="TEXT")] = "that of the training data"
    """Of the weights, for their card."""
    quiet: bool = False
    """No lines of news."""

    def run(self) -> int:
        """Check, train, name the result."""
        from mapctl.commands.shared.resumption import explain_resumption

        with explain_resumption(self):
            path, use = self._run_training((lambda line: None) if self.quiet else _print_line)
        if not self.quiet:
            print(f"wrote {path}; use it with {use} {self.out}")
        return 0

    def _run_training(self, say: Callable[[str], None]) -> tuple[Path, str]:
        """The result, and the option that takes it."""
        if self.model == "refiner":
            from mapctl.commands.train import refiner

            return refiner.train_refiner(self, say), "--refiner"
        if self.model in ("denoiser", "infiller"):
            from mapctl.commands.train import windows

            return windows.train_on_windows(self, say), f"--{self.model}"
        request = self.request()
        from mapctl.commands.shared import outputs
        from priors.training import run

        outputs.check_folder(self.out)

        return run.train(request, say, warn=checks.warn), "--prior"

    def request(self) -> "DensityRequest":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.run import DensityRequest

        checks.check_options(self, model="a density", foreign=("architecture",), on_gpu=True)
        config, settings = self._recipe()
        return DensityRequest(
            data=self.data,
            out=self.out,
            match=self.match or "",
            config=config,
            settings=settings,
            resume=self.resume,
            device=self.device,
            checkpoint_minutes=self.minutes_between_checkpoints,
            licence=self.licence,
            skip_first=self.skip_first,
            labels=self.labels,
            init=self.init,
            strict_data=self.strict_data,
        )

    def _recipe(self) -> tuple["LstmGmmConfig", "TrainingSettings"]:
        from priors.lstm_gmm.network import LstmGmmConfig
        from priors.training.recipes.lstm_gmm import PAPER, TrainingSettings

        config, settings = PAPER if self.paper else (LstmGmmConfig(), TrainingSettings())
        shape = checks.select_given(self, "width", "components")
        if self.init is not None and (self.paper or shape):
            raise RequestError(
                "with --init the network is that prior's; --width, --components and --paper do not apply"
            )
        recipe = checks.select_given(self, "steps", "batch", "window", "learning_rate", "seed")
        return replace(config, **shape), replace(settings, bfloat16=self.bfloat16, **recipe)


def _print_line(line: str) -> None:
    # Flushed, so that a log file shows how far a run of hours has come.
    print(line, flush=True)
