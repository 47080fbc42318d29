"""`mapctl train pose-transformer`: the options of a pose transformer."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mapctl.commands.shared import options
from mapctl.commands.train.options import TunableOptions
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from priors.training.recipes.pose_transformer import PoseTransformerRecipe


@dataclass(frozen=True)
class TrainPoseTransformer(TunableOptions):
    """Train the pose transformer that infill, tween, blend and chain begin with; --batch is in frames."""

    model = "pose-transformer"
    used_by = "use it with --inbetweener"

    width: options.MaybeCount = None
    """Numbers of a frame's token, even; every 32 of them have a head of attention."""
    layers: options.MaybeCount = None
    """Layers of attention."""
    detail: options.MaybeCount = None
    """Layers of a second stage, which corrects what the first proposes; the first then looks at frames alone in which
    something is known."""
    plain: bool = False
    """The plainest network of the kind, to compare: no convolutions, AdamW for all weights."""
    two_stage: bool = False
    """Two networks in turn as Qin et al. 2022 have them, for gaps of up to 70 frames between whole poses alone, to
    compare; its shape is its own."""

    def recipe(self) -> "PoseTransformerRecipe":
        """The options as the trainer takes them; RequestError for numbers that make no sense."""
        from priors.training.recipes.pose_transformer import (
            TWO_STAGE,
            PoseTransformerConfig,
            PoseTransformerRecipe,
            PoseTransformerSettings,
        )

        common = self.common()
        given = self.select_given("steps", "batch", "window", "seed", "learning_rate")
        shape = self.select_given("width", "layers", "detail")
        if self.width is not None:
            shape["heads"] = max(1, self.width // 32)
        if self.two_stage and (shape or self.plain):
            raise RequestError("--two-stage has a shape of its own: leave out --width, --layers, --detail and --plain")
        usual = TWO_STAGE if self.two_stage else (PoseTransformerConfig(), PoseTransformerSettings())
        plain = ({"kernel": 0}, {"optimiser": "adam", "learning_rate": 8e-4}) if self.plain else ({}, {})
        return PoseTransformerRecipe(
            **common,
            config=replace(usual[0], **plain[0], **shape),
            settings=replace(usual[1], bfloat16=self.bfloat16, **{**plain[1], **given}),
            skip_first=self.skip_first,
            init=self.init,
        )
