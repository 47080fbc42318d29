"""Kinds of windows and of frames: the gait of a second, and where each foot is in its step."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.features import PRIOR_FPS
from mapctl.metrics import body
from mapctl.metrics.realism.windows import HIPS, WindowSettings, facing_angle, find_window_frames
from mapctl.numerics.gaussian import low_pass
from mapctl.skeleton import TOE_JOINTS

GAITS = ("standing", "slow walk", "walk", "run", "turning", "sideways", "backwards")
"""Gaits of a second, in the order of the table."""
FOOT_PHASES = ("planted", "lift", "swing", "landing")
"""Where a foot is in its step."""
BODY_PHASES = ("landing", "lift", "on one foot", "on both feet", "in flight")
"""Where a body is in its step: landing while either foot lands, else lifting while either lifts, else by its feet."""

_STANDING, _SLOW, _RUN = 0.2, 0.8, 1.9  # m/s
_TURNING = math.radians(25)  # rad/s
_SIDEWAYS, _BACKWARDS = math.radians(60), math.radians(120)
_NEAR = 2  # frames before and after a contact's begin or end that count as landing or lift


def classify_gaits(
    positions: Float[Tensor, "clip_frames joints 3"], settings: WindowSettings
) -> Int[Tensor, " windows"]:
    """Classify each window of a clip as one of GAITS, by its mean speed, turning and direction of travel.

    Under 0.2 m/s it is standing; else backwards or sideways where it travels more than 120 or 60 degrees from where it
    faces; else a run from 1.9 m/s, turning from 25 degrees/s, a slow walk under 0.8 m/s, and a walk. Each stride's
    swing is smoothed away, as in `body.turn_rate`. RequestError for a clip shorter than a window.
    """
    frames, _, _ = find_window_frames(positions, settings)
    velocity = positions[:, HIPS, ::2].diff(dim=0, append=positions[-1:, HIPS, ::2]) * PRIOR_FPS
    velocity[-1] = velocity[-2]
    velocity = torch.stack([_smooth(axis) for axis in velocity.T], dim=-1)
    facing = _smooth(facing_angle(positions))
    speed, turned = velocity[frames].norm(dim=-1).mean(1), facing[frames[:, -1]] - facing[frames[:, 0]]
    course = torch.atan2(velocity[..., 0], velocity[..., 1])
    apart = rotations.wrap_angle(course - facing)[frames].abs().mean(1)
    rate = turned.abs() * PRIOR_FPS / (frames.shape[1] - 1)
    gait = torch.where(speed < _SLOW, GAITS.index("slow walk"), GAITS.index("walk"))
    gait[rate >= _TURNING] = GAITS.index("turning")
    gait[speed >= _RUN] = GAITS.index("run")
    gait[apart > _SIDEWAYS] = GAITS.index("sideways")
    gait[apart > _BACKWARDS] = GAITS.index("backwards")
    gait[speed < _STANDING] = GAITS.index("standing")
    return gait


def _smooth(signal: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    return low_pass(signal, seconds=body.TURN_SECONDS, fps=PRIOR_FPS)


def find_foot_phases(positions: Float[Tensor, "frames joints 3"]) -> Int[Tensor, "frames 2"]:
    """Find the phase of the left and the right foot in each frame of a clip, as indices into FOOT_PHASES.

    Landing and lift are two frames before to two after a toe's contact begins or ends; where both apply it lands.
    """
    planted = contacts.debounced(contacts.detect_contacts(positions[:, list(TOE_JOINTS)], PRIOR_FPS))
    phases = torch.where(planted, FOOT_PHASES.index("planted"), FOOT_PHASES.index("swing"))
    begins = torch.zeros_like(planted)
    ends = torch.zeros_like(planted)
    begins[1:], ends[1:] = planted[1:] & ~planted[:-1], planted[:-1] & ~planted[1:]
    phases[_spread(ends)] = FOOT_PHASES.index("lift")
    phases[_spread(begins)] = FOOT_PHASES.index("landing")
    return phases


def _spread(events: Bool[Tensor, "frames feet"]) -> Bool[Tensor, "frames feet"]:
    """Widen events to the frames near them."""
    padded = torch.nn.functional.pad(events.T.float(), (_NEAR, _NEAR))
    return padded.unfold(-1, 2 * _NEAR + 1, 1).amax(dim=-1).T > 0


def join_foot_phases(feet: Int[Tensor, "*frames 2"]) -> Int[Tensor, "*frames"]:
    """Return the phase of the body, as an index into BODY_PHASES, from those of both feet."""
    down = (feet == FOOT_PHASES.index("planted")).sum(dim=-1)
    body_phase = torch.tensor([BODY_PHASES.index(name) for name in ("in flight", "on one foot", "on both feet")])[down]
    body_phase[(feet == FOOT_PHASES.index("lift")).any(dim=-1)] = BODY_PHASES.index("lift")
    body_phase[(feet == FOOT_PHASES.index("landing")).any(dim=-1)] = BODY_PHASES.index("landing")
    return body_phase
