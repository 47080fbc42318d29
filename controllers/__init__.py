"""The jobs: each turns a request into terms, solves, and returns a Solution."""

from typing import TYPE_CHECKING

from mapctl.lazy import import_lazily

if TYPE_CHECKING:
    from controllers.denoising.denoise import DenoiseSettings as DenoiseSettings
    from controllers.denoising.denoise import denoise as denoise
    from controllers.generation.generate import GenerateSettings as GenerateSettings
    from controllers.generation.generate import generate as generate
    from controllers.inbetweening.blend import blend as blend
    from controllers.inbetweening.infill import chain as chain
    from controllers.inbetweening.infill import infill as infill
    from controllers.inbetweening.infill import retraced as retraced
    from controllers.inbetweening.pipeline import INFILL_REFINEMENT as INFILL_REFINEMENT
    from controllers.inbetweening.proposers import AutoInbetweener as AutoInbetweener
    from controllers.inbetweening.proposers import RolloutInbetweener as RolloutInbetweener
    from controllers.inbetweening.proposers import SlerpInbetweener as SlerpInbetweener
    from controllers.inbetweening.tween import tween as tween
    from controllers.shots.shot import follow as follow
    from controllers.shots.walk import FollowSettings as FollowSettings
    from controllers.steering import steer as steer
    from mapctl.intent.keyframes import Drawing as Drawing
    from mapctl.intent.keyframes import Key as Key
    from mapctl.intent.keyframes import Keys as Keys

# A process does one job or two, and all of them take longer to import than a second of walking takes to solve.
_NAMES = {
    "controllers.denoising.denoise": ("DenoiseSettings", "denoise"),
    "controllers.shots.shot": ("follow",),
    "controllers.shots.walk": ("FollowSettings",),
    "controllers.generation.generate": ("GenerateSettings", "generate"),
    "controllers.inbetweening.blend": ("blend",),
    "controllers.inbetweening.infill": ("chain", "infill", "retraced"),
    "controllers.inbetweening.pipeline": ("INFILL_REFINEMENT",),
    "controllers.inbetweening.proposers": ("AutoInbetweener", "RolloutInbetweener", "SlerpInbetweener"),
    "controllers.inbetweening.tween": ("tween",),
    "mapctl.intent.keyframes": ("Drawing", "Key", "Keys"),
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names}
__getattr__, __dir__ = import_lazily(__name__, _HOMES, {"steer": "controllers.steering.steer"}, ())
