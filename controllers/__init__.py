"""The jobs: each turns a request into terms, solves, and returns a Solution."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controllers.denoising.denoise import DenoiseSettings as DenoiseSettings
    from controllers.denoising.denoise import denoise as denoise
    from controllers.following.follow import FollowSettings as FollowSettings
    from controllers.following.follow import follow as follow
    from controllers.generation.generate import GenerateSettings as GenerateSettings
    from controllers.generation.generate import generate as generate
    from controllers.inbetweening.blend import blend as blend
    from controllers.inbetweening.infill import InfillSettings as InfillSettings
    from controllers.inbetweening.infill import chain as chain
    from controllers.inbetweening.infill import infill as infill
    from controllers.inbetweening.infill import retraced as retraced
    from controllers.inbetweening.proposers import AutoInbetweener as AutoInbetweener
    from controllers.inbetweening.proposers import RolloutInbetweener as RolloutInbetweener
    from controllers.inbetweening.proposers import SlerpInbetweener as SlerpInbetweener
    from controllers.inbetweening.tween import tween as tween
    from controllers.steering import steer as steer
    from mapctl.intent.keyframes import Drawing as Drawing
    from mapctl.intent.keyframes import Key as Key
    from mapctl.intent.keyframes import Keys as Keys

__all__ = [
    "AutoInbetweener",
    "DenoiseSettings",
    "Drawing",
    "FollowSettings",
    "GenerateSettings",
    "InfillSettings",
    "Key",
    "Keys",
    "RolloutInbetweener",
    "SlerpInbetweener",
    "blend",
    "chain",
    "denoise",
    "follow",
    "generate",
    "infill",
    "retraced",
    "steer",
    "tween",
]

# A process does one job or two, and all of them take longer to import than a second of walking takes to solve.
_HOMES = {
    "DenoiseSettings": "controllers.denoising.denoise",
    "denoise": "controllers.denoising.denoise",
    "FollowSettings": "controllers.following.follow",
    "follow": "controllers.following.follow",
    "GenerateSettings": "controllers.generation.generate",
    "generate": "controllers.generation.generate",
    "blend": "controllers.inbetweening.blend",
    "chain": "controllers.inbetweening.infill",
    "InfillSettings": "controllers.inbetweening.infill",
    "infill": "controllers.inbetweening.infill",
    "retraced": "controllers.inbetweening.infill",
    "AutoInbetweener": "controllers.inbetweening.proposers",
    "RolloutInbetweener": "controllers.inbetweening.proposers",
    "SlerpInbetweener": "controllers.inbetweening.proposers",
    "tween": "controllers.inbetweening.tween",
    "steer": "controllers.steering.steer",
    "Drawing": "mapctl.intent.keyframes",
    "Key": "mapctl.intent.keyframes",
    "Keys": "mapctl.intent.keyframes",
}


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'controllers' has no attribute {name!r}")
    module = import_module(_HOMES[name])
    return module if name == "steer" else getattr(module, name)


def __dir__() -> list[str]:
    """Return the public names, which arrive on first use; what was imported for them is not meant for users."""
    return __all__
