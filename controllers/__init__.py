"""The jobs: each turns a request into terms, solves, and returns a Solution."""

# Imported at once: a lazy name that is also a module's would be the module or the function by order of import.
from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.following.follow import FollowSettings, follow
from controllers.generation.generate import GenerateSettings, generate
from controllers.inbetweening.blend import blend
from controllers.inbetweening.chain import chain
from controllers.inbetweening.infill import InfillSettings, infill, retraced
from controllers.inbetweening.proposers import AutoInbetweener, RolloutInbetweener, SlerpInbetweener
from controllers.inbetweening.tween import tween
from controllers.steering import steer
from mapctl.intent.keyframes import Drawing, Key, Keys

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
