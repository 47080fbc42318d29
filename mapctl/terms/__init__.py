"""The terms of the MAP problem. A new one is a file here, a name below and an instance in tests/catalogue.py."""

from mapctl.terms.base import Term
from mapctl.terms.foot_contact import Clearance, FootContact, LandingSigmas
from mapctl.terms.likelihood import LatentPrior, Likelihood
from mapctl.terms.motion_tracking import MotionTracking
from mapctl.terms.path import Path
from mapctl.terms.positions import Jerk, KeepApart, KeepClear, Keyframe, WithinReach
from mapctl.terms.steering import RootVelocity, StepLength
from mapctl.terms.trial import Trial

__all__ = [
    "Clearance",
    "FootContact",
    "Jerk",
    "KeepApart",
    "KeepClear",
    "Keyframe",
    "LandingSigmas",
    "LatentPrior",
    "Likelihood",
    "MotionTracking",
    "Path",
    "RootVelocity",
    "StepLength",
    "Term",
    "Trial",
    "WithinReach",
]
