"""Walk a drawn curve (rnn paper, section 5.2): choose a start, then solve window after window."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.feasibility import check_path, check_tracking
from controllers.common.initial_state import select_initial_state
from mapctl.curves import Curve
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import PathRequest, SpeedProfile
from mapctl.pose import decode
from mapctl.problem.receding_horizon import HorizonSettings, RecedingHorizonSolver, TermsOf
from mapctl.problem.solution import Solution, Status
from mapctl.problem.window_solvers import LatentNoiseSolver, SingleWindowSolver
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms import FootContact, LatentPrior, Path, Term


@dataclass(frozen=True)
class FollowSettings:
    """Sigmas and search of a followed curve; the terms' own docstrings give the meaning."""

    path_sigma_slow: float = Path.sigma_slow
    """Sideways offset after its slow part is taken, metres."""
    path_free_sway: float = Path.free_sway
    """Sideways offset that is left to the walker, metres."""
    path_sigma_raw: float = Path.sigma_raw
    """Sideways offset beyond it, metres."""
    path_sigma_progress: float = Path.sigma_progress
    """Arc missing or too much, metres."""
    footing: FootContact = field(default_factory=FootContact)
    """Planted feet."""
    noise: LatentPrior = field(default_factory=lambda: LatentPrior(sigma=2.0))
    """The prior, in the latents of its rollout. A well trained prior's own spread is small: at sigma 1 the same walk
    holds its path and its feet less well (docs/results.md)."""
    window: HorizonSettings = field(default_factory=HorizonSettings)
    """How windows are laid."""
    method: SingleWindowSolver = field(default_factory=LatentNoiseSolver)
    """How one window is solved."""
    joint: str = "hips"
    """Which joint follows the curve."""

    def scaled_to(self, person: Character) -> "FollowSettings":
        """The same sigmas for somebody of this size, in metres of the prior's size."""
        if person.scale == 1.0:
            return self
        sigmas = {
            name: getattr(self, name) / person.scale
            for name in ("path_sigma_slow", "path_free_sway", "path_sigma_raw", "path_sigma_progress")
        }
        return replace(self, footing=person.footing(self.footing), **sigmas)


def follow(
    prior: Density,
    curve: Curve,
    *,
    seconds: float | None = None,
    speed: float | SpeedProfile = 1.2,
    generator: torch.Generator | None = None,
    settings: FollowSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
    progress: Callable[[int, int], None] | None = None,
    deadline_seconds: float | None = None,
) -> Solution:
    """Walk a character along the curve from its first point, facing along it.

    `speed` is m/s or a profile along the arc; without `seconds` the curve is walked once. `terms` are the caller's own,
    the same in every window; they see the character at its own size and the time since the first frame. On another
    `skeleton` (canonical names) strides are as long as its legs, and the toes' rest height is that of
    `settings.footing`. The first frame is the start pose. The motion is at PRIOR_FPS; `Motion.resample` gives other
    rates. After `deadline_seconds` of wall clock, and at Ctrl-C, what is solved by then comes back and the status says
    so. RequestError for wishes that make no sense; wishes that cannot hold are named with numbers in the status.
    """
    began = time.perf_counter()
    deadline = None if deadline_seconds is None else time.monotonic() + deadline_seconds
    profile = speed if isinstance(speed, SpeedProfile) else SpeedProfile.constant(speed)
    request, lowered = PathRequest(curve, profile, seconds).fitted(PRIOR_FPS)
    settings = settings or FollowSettings()
    person = Character(skeleton, settings.footing.rest_height)
    generator = generator or torch.Generator().manual_seed(0)
    frames = request.frames(PRIOR_FPS)
    # Windows look ahead beyond the last frame, so the wanted arcs go on that far.
    arcs = request.arcs(frames + settings.window.frames, PRIOR_FPS)
    seen, seen_arcs = person.curve(curve), arcs / person.scale
    more = [person.term(term) for term in terms]
    terms_of = build_follow_terms(seen, seen_arcs, settings.scaled_to(person), more)
    start = select_initial_state(
        prior, seen, seen_arcs, terms_of, skeleton=person.unit_skeleton, fps=PRIOR_FPS, generator=generator
    )
    solver = RecedingHorizonSolver(prior, settings.window, person.unit_skeleton, method=settings.method)
    done, outcome = solver.solve(
        start.committed, terms_of, frames, generator=generator, progress=progress, deadline=deadline
    )
    motion = person.motion(decode(done.features, start.before_first, skeleton=person.unit_skeleton))
    notes = [lowered] if lowered else []
    notes += check_path(request, arcs[:frames], person.data_limits(prior.limits))
    notes += check_tracking(motion, curve, settings.joint)
    status = Status(outcome).with_notes(notes, infeasible=bool(notes))
    ledger, seconds = person.ledger(done.ledger), time.perf_counter() - began
    return Solution(motion, status, ledger, done.windows, done.features, seconds)


def build_follow_terms(
    curve: Curve, arcs: Float[Tensor, " frames"], settings: FollowSettings, more: Sequence[Term] = ()
) -> TermsOf:
    """Build the terms of each window, for the wanted arcs of all frames and the look-ahead beyond them."""
    path = Path(
        curve,
        arcs,
        joint=settings.joint,
        sigma_slow=settings.path_sigma_slow,
        free_sway=settings.path_free_sway,
        sigma_raw=settings.path_sigma_raw,
        sigma_progress=settings.path_sigma_progress,
    )

    def terms(first: int, frames: int) -> Sequence[Term]:
        return settings.noise, replace(path, arcs=arcs[first : first + frames]), settings.footing, *more

    return terms
