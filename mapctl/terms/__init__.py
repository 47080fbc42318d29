"""The terms of the MAP problem. A new one is a file here, a name below and an instance in tests/catalogue.py."""

from mapctl.terms.base import Term
from mapctl.terms.clearance import Clearance
from mapctl.terms.closeness import Closeness
from mapctl.terms.footing import Footing
from mapctl.terms.keyframe import Keyframe
from mapctl.terms.likelihood import Likelihood
from mapctl.terms.noise import Noise
from mapctl.terms.observation import Observation
from mapctl.terms.path import Path
from mapctl.terms.seam import Seam
from mapctl.terms.steps import Steps
from mapctl.terms.support import Support
from mapctl.terms.travel import Travel

ALL = (Likelihood, Noise, Path, Footing, Seam, Closeness, Steps, Travel, Observation, Keyframe, Clearance, Support)

__all__ = [
    "ALL",
    "Clearance",
    "Closeness",
    "Footing",
    "Keyframe",
    "Likelihood",
    "Noise",
    "Observation",
    "Path",
    "Seam",
    "Steps",
    "Support",
    "Term",
    "Travel",
]
