"""Walk so that the hips are at given arcs of a curve (Wang et al. 2019, section 5.2): select an initial state, then
solve a receding horizon."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import MotionStart, select_initial_state
from mapctl.curves import Curve
from mapctl.curves.tracking import track_arcs
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver, TermsOf
from mapctl.problem.solution import Outcome
from mapctl.problem.window_solvers import LatentNoiseSolver, SingleWindowSolver
from mapctl.protocols import DataLimits, Density
from mapctl.terms import FootContact, LandingSigmas, LatentPrior, Path, Term

_PATH_TOLERANCE_CM = 15.0
_OVERSHOOT = 0.15  # metres: the last frame of a walk may lie one frame's step beyond the end
_CORNER_SECONDS = 1.0


def check_path(curve: Curve, arcs: Float[Tensor, " frames"], limits: DataLimits) -> list[str]:
    """Note speeds and corners beyond the prior's data, and a curve that ends too soon."""
    notes = []
    speeds = torch.diff(arcs) * PRIOR_FPS
    fastest, slowest = round(float(speeds.max()), 3), round(float(speeds.min()), 3)
    if fastest > limits.fastest:
        notes.append(f"{fastest:.2f} m/s is faster than the prior's data, which reach {limits.fastest:.2f} m/s")
    if slowest < limits.slowest:
        notes.append(f"{slowest:.2f} m/s is slower than the prior's data, which begin at {limits.slowest:.2f} m/s")
    notes += _check_corners(curve, arcs, limits)
    if not curve.closed and float(arcs[-1]) > curve.length + _OVERSHOOT:
        over = float(arcs[-1]) - curve.length
        notes.append(f"the last {over:.1f} m go straight on beyond the end of the curve of {curve.length:.1f} m")
    return notes


def check_tracking(motion: Motion, curve: Curve) -> list[str]:
    """Note the interval around the worst frame in which the path error exceeds 15 cm, if there is one."""
    walked = motion.root_position
    positions = walked[:, ::2] if curve.dims == 2 else walked
    error = (positions - curve.point(track_arcs(curve, walked, start=0.0))).norm(dim=-1)
    if float(error.max()) * 100 <= _PATH_TOLERANCE_CM:
        return []
    interval = _find_interval_around(error * 100 > _PATH_TOLERANCE_CM, int(error.argmax()))
    first, last = (float(frame / motion.fps) for frame in interval)
    return [f"the curve is left by up to {100 * float(error.max()):.0f} cm between {first:.1f} and {last:.1f} s"]


def _find_interval_around(off: Bool[Tensor, " frames"], worst: int) -> tuple[int, int]:
    """Find the first and the last frame of the unbroken interval around the worst one."""
    inside = (~off).nonzero()[:, 0]
    before, after = inside[inside < worst], inside[inside > worst]
    return int(before[-1]) + 1 if len(before) else 0, int(after[0]) - 1 if len(after) else len(off) - 1


def _check_corners(curve: Curve, arcs: Tensor, limits: DataLimits) -> list[str]:
    """Note the sharpest turn over one second of the walk (or all of a shorter one), if it is beyond the data."""
    step = min(round(_CORNER_SECONDS * PRIOR_FPS), len(arcs) - 1)
    samples = curve.curvature(arcs) * torch.gradient(arcs)[0]
    turned = torch.nn.functional.pad(samples.cumsum(0), (1, 0))
    turned = (turned[step:] - turned[:-step]).abs()
    worst = int(turned.argmax())
    if float(turned[worst]) <= limits.turn_rate:
        return []
    degrees, able = (torch.rad2deg(torch.tensor(v)).item() for v in (float(turned[worst]), limits.turn_rate))
    return [
        f"the curve turns {degrees:.0f} degrees within a second at {float(arcs[worst]):.1f} m, "
        f"where the prior's data turn at most {able:.0f}"
    ]


@dataclass(frozen=True)
class FollowSettings:
    """Sigmas and search of path following; the terms' own docstrings give the meaning."""

    path_sigma_slow: float = Path.sigma_slow
    """Sigma of the slow part of the sideways offset, metres."""
    path_free_sway: float = Path.free_sway
    """Sideways offset that costs nothing, metres."""
    path_sigma_raw: float = Path.sigma_raw
    """Sigma of the sideways offset beyond the free sway, metres."""
    path_sigma_progress: float = Path.sigma_progress
    """Sigma of the arc behind or ahead of the requested one, metres."""
    footing: FootContact = field(default_factory=lambda: FootContact(landing=LandingSigmas()))
    """Contact term."""
    noise: LatentPrior = field(default_factory=lambda: LatentPrior(sigma=3.0))
    """Prior on the latent noise of the rollout. A well trained prior's own standard deviation is small: at sigma 2 the
    same walk follows its path less well; at sigma 4 the prior of the free set is led where it knows nothing."""
    window: HorizonSettings = field(default_factory=HorizonSettings)
    """Lengths of the receding horizon."""
    method: SingleWindowSolver = field(default_factory=LatentNoiseSolver)
    """Solver of one window."""

    def with_rest_height(self, height: float) -> "FollowSettings":
        """Return the settings for feet whose toe joints rest at this `height` over the floor, metres."""
        return replace(self, footing=replace(self.footing, rest_height=height))

    def scaled_to(self, character: Character) -> "FollowSettings":
        """Return the settings for a character of this size, in metres of the prior's size."""
        sigmas = {
            name: getattr(self, name) / character.scale
            for name in ("path_sigma_slow", "path_free_sway", "path_sigma_raw", "path_sigma_progress")
        }
        return replace(self, footing=character.footing(self.footing), **sigmas)


def walk_arcs(
    prior: Density,
    curve: Curve,
    arcs: Float[Tensor, " ahead"],
    frames: int,
    *,
    character: Character,
    settings: FollowSettings,
    generator: torch.Generator,
    terms_of: TermsOf = lambda _first, _frames: (),
    start: MotionStart | None = None,
    first_frame: int = 0,
    progress: Callable[[int, int], None] | None = None,
    deadline: float | None = None,
) -> tuple[Motion, CommittedFrames, Outcome]:
    """Walk a character along a curve so that it is at one arc (metres) in each frame; arcs extend a window beyond.

    Its first frame is `first_frame` of the shot. It begins in `start`, of the prior's size, or in the initial state
    that suits the arcs best. `terms_of` gives more terms for each window, which see the character at its own size. The
    ledger is of the prior's size.
    """
    unit_curve, unit_arcs = character.curve(curve), arcs / character.scale
    follow_terms = build_follow_terms(unit_curve, unit_arcs, settings.scaled_to(character))

    def all_terms(first: int, count: int) -> Sequence[Term]:
        return *follow_terms(first, count), *(character.term(term) for term in terms_of(first, count))

    if start is None:
        start = select_initial_state(
            prior,
            unit_curve,
            unit_arcs,
            all_terms,
            skeleton=character.unit_skeleton,
            fps=PRIOR_FPS,
            generator=generator,
        )
    committed = replace(start.committed, discarded=first_frame)  # so that terms see the time in the shot
    solver = RecedingHorizonSolver(prior, settings.window, character.unit_skeleton, method=settings.method)
    done, outcome = solver.solve(
        committed, all_terms, frames, generator=generator, progress=progress, deadline=deadline
    )
    motion = character.motion(decode(done.features, start.before_first, skeleton=character.unit_skeleton))
    return motion, done, outcome


def build_follow_terms(curve: Curve, arcs: Float[Tensor, " frames"], settings: FollowSettings) -> TermsOf:
    """Build the terms of each window, for the requested arcs of all frames and the look-ahead beyond them."""
    path = Path(
        curve,
        arcs,
        sigma_slow=settings.path_sigma_slow,
        free_sway=settings.path_free_sway,
        sigma_raw=settings.path_sigma_raw,
        sigma_progress=settings.path_sigma_progress,
    )

    def terms(first: int, frames: int) -> Sequence[Term]:
        return settings.noise, replace(path, arcs=arcs[first : first + frames]), settings.footing

    return terms
