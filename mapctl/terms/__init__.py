"""The terms of the MAP problem. A new one is a file here, a name below and an instance in tests/catalogue.py."""

from mapctl.terms.base import Term
from mapctl.terms.clearance import Clearance
from mapctl.terms.foot_contact import Footing
from mapctl.terms.jerk import Seam
from mapctl.terms.keyframe import Keyframe
from mapctl.terms.latent_prior import Noise
from mapctl.terms.likelihood import Likelihood
from mapctl.terms.motion_tracking import Closeness
from mapctl.terms.observation import Observation
from mapctl.terms.path import Path
from mapctl.terms.root_velocity import Travel
from mapctl.terms.step_length import Steps
from mapctl.terms.support import Support

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
