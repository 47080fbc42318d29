"""`mapctl train`: a model from a folder of BVH. One class of options a model, each in a file of its own."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated

from tyro.conf import subcommand

from mapctl.commands.train.denoiser import TrainDenoiser
from mapctl.commands.train.infiller import TrainInfiller
from mapctl.commands.train.keyframe_timing import TrainKeyframeTiming
from mapctl.commands.train.lstm_gmm import TrainDensity
from mapctl.commands.train.options import TrainOptions
from mapctl.commands.train.path import TrainPath
from mapctl.commands.train.pose_transformer import TrainPoseTransformer
from mapctl.commands.train.refiner import TrainRefiner
from mapctl.commands.train.stitcher import TrainStitcher
from mapctl.commands.train.tweener import TrainTweener
from mapctl.commands.train.whole_set import TrainAll

MODELS: tuple[type[TrainOptions], ...] = (
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
"""Whatever can be trained: the options of each recipe in `priors.training.recipes`."""

KINDS: Mapping[str, type[TrainOptions] | type[TrainAll]] = {
    **{kind.model: kind for kind in MODELS},
    TrainAll.model: TrainAll,
}
"""What `mapctl train` takes, by its name: one model, or all."""

if TYPE_CHECKING:
    AnyModel = TrainOptions
else:
    AnyModel = reduce(or_, (Annotated[kind, subcommand(name, prefix_name=False)] for name, kind in KINDS.items()))


@dataclass(frozen=True)
class Train:
    """Train a model on a folder of BVH; interrupted or killed and resumed, a run gives the same weights."""

    model: AnyModel
    """What to train."""

    def run(self) -> int:
        """Train it."""
        return self.model.run()
