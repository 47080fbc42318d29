"""Foot clean-up of a generated motion: feet are planted where its own contact labels are 1 (Wang et al. 2019, section
4.3).

A receding-horizon MAP over the motion's latent noise: the latent prior removes jitter, the contact term removes foot
skate, and motion tracking keeps the rest. Works piece by piece in constant memory.
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
from mapctl.terms import FootContact, LandingSigmas, LatentPrior, MotionTracking, Term
from mapctl.terms.base import ViewedTerm
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class FootCleanupSettings:
    """Contact term and windows of the foot clean-up."""

    footing: FootContact = field(
        default_factory=lambda: FootContact(
            sigma_speed=0.06, sigma_height=0.02, sigma_below=0.002, landing=LandingSigmas()
        )
    )
    """Contact term. Mocap's planted feet move a little, and a foot rests higher at one contact than at the next, though
    never lower than flat: feet that are perfectly still or all at one height would be distinguishable from them."""
    window: HorizonSettings = field(default_factory=HorizonSettings)
    """Lengths of the receding horizon."""

    def scaled_to(self, character: Character) -> "FootCleanupSettings":
        """Return the settings for a character of this size, in metres of the prior's size."""
        return replace(self, footing=character.footing(self.footing))


def clean_up_feet(
    prior: Density,
    pieces: Iterable[Float[Tensor, "_ size"]],
    *,
    frames: int,
    state: DensityState,
    generator: torch.Generator,
    ground_pose: GroundPose | None = None,
    settings: FootCleanupSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
    record: Callable[[CommittedFrames], None] | None = None,
    find_prior: Callable[[int], Density] | None = None,
) -> Iterator[Float[Tensor, "_ size"]]:
    """Clean up the feet of the first `frames` of consecutive pieces of features, contact labels debounced.

    `state` and `ground_pose` (default: the origin) are the density's and the character's before the first frame, batch
    of one. `terms` are the caller's own, the same in every window; `record` is called with each solved window.
    `find_prior` finds what a frame was sampled from, counted from 0, where that is not the `prior` all along: a window
    is solved with that of the middle of the frames that it commits. Windows look ahead, so the pieces must hold
    `settings.window.frames` more frames than requested; RequestError otherwise.
    """
    settings, ground_pose = settings or FootCleanupSettings(), ground_pose or GroundPose.origin()
    ground_pose = GroundPose(ground_pose.position_xz.float(), ground_pose.heading.float())
    still = torch.zeros(0, skeleton.num_joints, 3)
    done = CommittedFrames(state, ground_pose, state.last_frame.float(), still, discarded=-1)
    travelled = torch.zeros(2)  # offset from the world's origin to the windows' own
    waiting, left = torch.zeros(0, LAYOUT.size), frames
    for piece in pieces:
        waiting = torch.cat([waiting, piece.float()])
        while left > 0 and len(waiting) >= settings.window.frames:
            count = min(settings.window.frames - settings.window.overlap, left)
            window = _debounce_window_contacts(done.features, waiting[: settings.window.frames])
            caller_terms = [ViewedTerm(term, partial(_move_trial, offset=travelled)) for term in terms]
            sampled_from = prior if find_prior is None else find_prior(frames - left + count // 2)
            done = _clean_up_window(sampled_from, done, window, count, settings, skeleton, generator, caller_terms)
            if record is not None:
                record(done)
            yield done.features[-count:]
            waiting, left, travelled = waiting[count:], left - count, travelled + done.ground_pose.position_xz
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
    caller_terms: Sequence[Term],
) -> CommittedFrames:
    """Commit `count` more frames; a window without a finite solution stays unchanged."""
    terms: tuple[Term, ...] = LatentPrior(), MotionTracking(window), settings.footing, *caller_terms
    method = GuidedNoiseSolver(window)
    solver = RecedingHorizonSolver(prior, settings.window, skeleton, method=method)
    next_done, _ = solver.solve(done, lambda first, frames: terms, len(done.features) + count, generator=generator)
    return next_done


def _move_trial(trial: Trial, offset: Float[Tensor, "2"]) -> Trial:
    """Translate a trial over the ground to its position in the world."""
    start = replace(trial.start, position_xz=trial.start.position_xz + offset)
    before, heels = (points + rotations.lift_ground(offset) for points in (trial.before, trial.heels_before))
    return replace(trial, start=start, before=before, heels_before=heels, world_poses=None)


def _discard_history(done: CommittedFrames) -> CommittedFrames:
    """Discard all frames that no later window reads, and move to the origin, where single precision is finest."""
    here = done.ground_pose.position_xz
    return replace(
        done.discard_history(MIN_CONTACT_FRAMES),
        joints_world=done.joints_world - rotations.lift_ground(here),
        ground_pose=GroundPose(torch.zeros_like(here), done.ground_pose.heading),
    )


def _debounce_window_contacts(
    before: Float[Tensor, "past size"], window: Float[Tensor, "frames size"]
) -> Float[Tensor, "frames size"]:
    """Remove contacts, and gaps in them, of less than MIN_CONTACT_FRAMES frames."""
    bits = LAYOUT.pick(torch.cat([before, window]), "contacts") > 0.5
    steady = debounced(bits)[len(before) :]
    return torch.cat([window[:, : LAYOUT.continuous], steady.to(window.dtype)], dim=-1)
