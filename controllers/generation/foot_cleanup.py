"""Finish a generated motion: feet that its own contact labels call planted stand, and the rest follows (section 4.3).

A sliding-window MAP over the latents of the motion: the noise prior takes the tremble away, footing the slide, and
closeness keeps what the motion does. Works piece by piece in memory that does not grow.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from mapctl import rotations
from mapctl.contacts import MIN_CONTACT_FRAMES, debounced
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, GroundPose
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver
from mapctl.problem.window_solvers import GuidedNoiseSolver
from mapctl.protocols import Density, DensityState
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms import FootContact, LatentPrior, MotionTracking, Term
from mapctl.terms.base import ViewedTerm
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class FootCleanupSettings:
    """Sigmas and search of the finishing pass; the terms' own docstrings give the meaning."""

    sigma_noise: float = 1.0
    """Of the noise prior: above 1 leaves more of the motion's own tremble."""
    sigma_pose: float = MotionTracking.sigma_pose
    """Distance of joints from the motion's, metres."""
    sigma_trajectory: float = MotionTracking.sigma_trajectory
    """Way over the ground within a window, metres."""
    sigma_heading: float = MotionTracking.sigma_heading
    """Turn within a window, radians."""
    footing: FootContact = field(default_factory=lambda: FootContact(sigma_speed=0.06))
    """Planted feet. Mocap's own move a little: feet that stood still would be told from them."""
    window: HorizonSettings = field(default_factory=HorizonSettings)
    """How windows are laid."""
    share: float = GuidedNoiseSolver.share
    """Of the motion's noise that the search starts with."""

    def scaled_to(self, person: Character) -> "FootCleanupSettings":
        """The same for somebody of this size, in metres of the prior's size."""
        return self if person.scale == 1.0 else replace(self, footing=person.footing(self.footing))


def clean_up_feet(
    prior: Density,
    pieces: Iterable[Float[Tensor, "_ size"]],
    *,
    frames: int,
    state: DensityState,
    generator: torch.Generator,
    place: GroundPose | None = None,
    settings: FootCleanupSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
    record: Callable[[CommittedFrames], None] | None = None,
) -> Iterator[Float[Tensor, "_ size"]]:
    """Clean up the feet of the first `frames` of consecutive pieces of features, contact labels debounced.

    `state` and `place` (the origin) are the density's and the character's before the first frame, batch of one. `terms`
    are the caller's own, the same in every window; `record` is called with each window that was solved. Windows look
    ahead, so the pieces must hold `settings.window.frames` more than are asked for; RequestError where they do not.
    """
    settings, place = settings or FootCleanupSettings(), place or GroundPose.origin()
    place = GroundPose(place.position_xz.float(), place.heading.float())
    still = torch.zeros(0, skeleton.num_joints, 3)
    done = CommittedFrames(state, place, state.last_frame.float(), still, discarded=-1)
    away = torch.zeros(2)  # of the world's origin from the windows' own
    waiting, left = torch.zeros(0, LAYOUT.size), frames
    for piece in pieces:
        waiting = torch.cat([waiting, piece.float()])
        while left > 0 and len(waiting) >= settings.window.frames:
            count = min(settings.window.frames - settings.window.overlap, left)
            window = _debounce_window_contacts(done.features, waiting[: settings.window.frames])
            own = [ViewedTerm(term, partial(_move_trial, away=away)) for term in terms]
            done = _clean_up_window(prior, done, window, count, settings, skeleton, generator, own)
            if record is not None:
                record(done)
            yield done.features[-count:]
            waiting, left, away = waiting[count:], left - count, away + done.place.position_xz
            done = _discard_history(done)
    if left > 0:
        raise RequestError(
            f"finishing needs {left + settings.window.frames - len(waiting)} more frames than it was given"
        )


def _clean_up_window(
    prior: Density,
    done: CommittedFrames,
    window: Float[Tensor, "frames size"],
    count: int,
    settings: FootCleanupSettings,
    skeleton: Skeleton,
    generator: torch.Generator,
    more: Sequence[Term],
) -> CommittedFrames:
    """Commit `count` more frames; a window without a finite solution is left as it was."""
    closeness = MotionTracking(
        window,
        sigma_pose=settings.sigma_pose,
        sigma_trajectory=settings.sigma_trajectory,
        sigma_heading=settings.sigma_heading,
    )
    terms: tuple[Term, ...] = LatentPrior(settings.sigma_noise), closeness, settings.footing, *more
    method = GuidedNoiseSolver(window, share=settings.share)
    solver = RecedingHorizonSolver(prior, settings.window, skeleton, method=method)
    following, _ = solver.solve(done, lambda first, frames: terms, len(done.features) + count, generator=generator)
    return following


def _move_trial(trial: Trial, away: Float[Tensor, "2"]) -> Trial:
    """Move a trial over the ground to where it is in the world."""
    start = replace(trial.start, position_xz=trial.start.position_xz + away)
    return replace(trial, start=start, before=trial.before + rotations.lift_ground(away))


def _discard_history(done: CommittedFrames) -> CommittedFrames:
    """Discard all that no later window looks at, and move to the origin, where single precision is finest."""
    here = done.place.position_xz
    return replace(
        done.discard_history(MIN_CONTACT_FRAMES),
        joints_world=done.joints_world - rotations.lift_ground(here),
        place=GroundPose(torch.zeros_like(here), done.place.heading),
    )


def _debounce_window_contacts(
    before: Float[Tensor, "past size"], window: Float[Tensor, "frames size"]
) -> Float[Tensor, "frames size"]:
    """Remove contacts, and gaps in them, of less than MIN_CONTACT_FRAMES frames."""
    bits = LAYOUT.pick(torch.cat([before, window]), "contacts") > 0.5
    steady = debounced(bits)[len(before) :]
    return torch.cat([window[:, : LAYOUT.continuous], steady.to(window.dtype)], dim=-1)
