"""The jobs: each turns a request into terms, solves, and returns a Solution."""

# Imported at once: a lazy name that is also a module's would be the module or the function by order of import.
from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.following.follow import FollowSettings, follow
from controllers.generation.generate import GenerateSettings, generate
from controllers.inbetweening.infill import InfillSettings, infill
from controllers.inbetweening.tween import tween
from mapctl.intent.keyframes import Key, Keys

__all__ = [
    "DenoiseSettings",
    "FollowSettings",
    "GenerateSettings",
    "InfillSettings",
    "Key",
    "Keys",
    "denoise",
    "follow",
    "generate",
    "infill",
    "tween",
]
