"""Walk so that the hips are at given arcs of a curve (Wang et al. 2019, section 5.2): select an initial state, then
solve a receding horizon of windows whose terms are the path, contacts and the prior on the noise."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import MotionStart, select_initial_state
from controllers.shots.footsteps import hold_footsteps
from controllers.shots.request import ShotRequest
from controllers.shots.trajectory import Span, Trajectory, cut_curve, lay_stands, lay_timeline
from mapctl.curves import Curve
from mapctl.curves.tracking import track_arcs
from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.intent.path import find_reversals, walk_at_ease
from mapctl.metrics.body import measure_accelerations
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import decode
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver, TermsOf
from mapctl.problem.solution import Outcome
from mapctl.problem.window_solvers import LatentNoiseSolver, SingleWindowSolver
from mapctl.protocols import DataLimits, Density
from mapctl.runtime.stepwise import Progress
from mapctl.terms import FootContact, KeepApart, KeepClear, LandingSigmas, LatentPrior, Path, Term


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
    noise: LatentPrior = field(default_factory=LatentPrior)
    """Prior on the latent noise of the rollout."""
    liveliness: float = 0.5
    """Standard deviation of the noise that is drawn once for each frame, about which the prior is centred: 0 is the
    most probable walk, smoother than captured ones."""
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
    drawn = settings.liveliness * torch.randn(len(arcs), LAYOUT.continuous, generator=generator)
    follow_terms = build_follow_terms(unit_curve, unit_arcs, settings.scaled_to(character), drawn)

    def all_terms(first: int, count: int) -> Sequence[Term]:
        return *follow_terms(first, count), *(character.term(term) for term in terms_of(first, count))

    if start is None:
        start = select_initial_state(
            prior, unit_curve, unit_arcs, all_terms, skeleton=character.unit_skeleton, generator=generator
        )
    committed = replace(start.committed, discarded=first_frame)  # so that terms see the time in the shot
    solver = RecedingHorizonSolver(prior, settings.window, character.unit_skeleton, method=settings.method)
    done, outcome = solver.solve(
        committed, all_terms, frames, generator=generator, progress=progress, deadline=deadline
    )
    motion = character.motion(decode(done.features, start.before_first, skeleton=character.unit_skeleton))
    return motion, done, outcome


def build_follow_terms(
    curve: Curve, arcs: Float[Tensor, " frames"], settings: FollowSettings, drawn: Float[Tensor, "frames noise"]
) -> TermsOf:
    """Build the terms of each window, for the requested arcs and the drawn noise of all frames, look-ahead included."""
    path = Path(
        curve,
        arcs,
        sigma_slow=settings.path_sigma_slow,
        free_sway=settings.path_free_sway,
        sigma_raw=settings.path_sigma_raw,
        sigma_progress=settings.path_sigma_progress,
    )

    def terms(first: int, frames: int) -> Sequence[Term]:
        window = slice(first, first + frames)
        noise = replace(settings.noise, centre=drawn[window])
        return noise, replace(path, arcs=arcs[window]), settings.footing

    return terms


TAIL = 14
"""Frames that a walk goes on for a later last step."""
_TRIES = 5  # walks of a span, of which the first that passes is taken, or the best
_MOST_OFF = 0.3  # metres from where hips of the prior's size were to be
MOST_ACCELERATION = 90.0
"""m/s^2 of any joint at PRIOR_FPS: captured walks, runs and gestures stay below (`mapctl measure FOLDER`)."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One span's motion, over all frames of the shot; frames outside of it hold."""

    span: Span
    """The span."""
    motion: Motion
    """As many frames as the shot has."""


def walk_spans(
    prior: Density,
    request: ShotRequest,
    trajectory: Trajectory,
    rest: Motion,
    *,
    character: Character,
    settings: FollowSettings,
    generator: torch.Generator,
    terms_of: TermsOf = lambda _first, _frames: (),
    progress: Progress | None = None,
    deadline: float | None = None,
) -> tuple[list[Piece], list[CommittedFrames], Outcome]:
    """Stand (in the pose `rest`) and walk along a trajectory, span by span; also return what was solved for each walk,
    and how that ended. `terms_of` is by frames of the shot.

    A walk that leaves its trajectory or lunges is solved again with another start and other noise.
    """
    frames, outcome, walks_only = len(trajectory.speeds), Outcome.DONE, request.walks_only
    slowest = character.data_limits(prior.limits).slowest
    pieces, walked = list[Piece](), list[CommittedFrames]()

    def shot_terms(begin: int, count: int) -> Sequence[Term]:
        found = [*terms_of(begin, count)]
        if request.footsteps:
            found.append(hold_footsteps(request.footsteps, begin, count, character.toe_rest_height))
        if request.obstacles:
            found.append(KeepClear(request.obstacles))
        if request.others is not None:
            hips = request.others.at(torch.arange(begin, begin + count))
            found.append(KeepApart(hips, request.others.distance + 0.05))
        return found

    spans = [Span("walk", 0, frames)]
    if not walks_only:
        spans = lay_stands(lay_timeline(trajectory.speeds, slowest=slowest), trajectory, request, rest)
    for span in spans:
        lead = request.lead if span.start == 0 else None
        if span.what == "stand":
            assert span.pose is not None
            pieces.append(Piece(span, _spread_over(span.pose, 0, frames)))
            continue
        tail = TAIL if span.stop < frames else 0
        length = span.stop - span.start + tail
        curve, arcs = trajectory.curve, _extend(trajectory.arcs[span.start : span.stop], tail + settings.window.frames)
        if span.start > 0:
            curve, arcs = cut_curve(curve, float(arcs[0]), float(arcs[-1]) + 1.0), arcs - arcs[0]
        start = None if lead is None else lead.start(prior, character)

        def report_frames(done: int, _: int, span: Span = span) -> None:
            if progress is not None:
                progress(min(span.start + done, span.stop), frames)

        best, least = None, math.inf
        for _ in range(_TRIES):
            motion, done, outcome = walk_arcs(
                prior,
                curve,
                arcs,
                length,
                character=character,
                settings=settings,
                generator=generator,
                terms_of=lambda first, count, begin=span.start: shot_terms(begin + first, count),
                start=start,
                first_frame=span.start,
                progress=report_frames,
                deadline=deadline,
            )
            if outcome is not Outcome.DONE:
                if walks_only:
                    return [Piece(span, motion)], [done], outcome
                if outcome is Outcome.INTERRUPTED:  # half a shot is none: its other half would stand still
                    raise KeyboardInterrupt
                raise MapctlError(f"the walk from frame {span.start} on {outcome.value}")
            fault = _measure_fault(motion, curve.ground_point(arcs[:length])) / character.scale
            if fault < least:
                best, least = (motion, done), fault
            if fault <= 1:
                break
        assert best is not None
        pieces.append(Piece(span, _spread_over(best[0], span.start, frames)))
        walked.append(best[1])
    return pieces, walked, outcome


def slows_in_corners(request: ShotRequest, curve: Curve) -> bool:
    """Return whether a walk slows in corners of a curve, where a foot pivots while it lies flat."""
    return request.speed is None and bool(len(walk_at_ease(curve).speeds) > 1 or find_reversals(curve))


def _measure_fault(motion: Motion, wanted: Float[Tensor, "frames 2"]) -> float:
    """Return the larger of the hips' distance from where they were to be at that time and the largest acceleration of a
    joint, as shares of what passes."""
    off = float((motion.root_position[:, ::2] - wanted.to(motion.root_position)).norm(dim=-1).max())
    accelerations = measure_accelerations(motion.joint_positions(), PRIOR_FPS)
    return max(off / _MOST_OFF, float(accelerations.max()) / MOST_ACCELERATION if len(accelerations) else 0.0)


def _extend(arcs: Float[Tensor, " frames"], more: int) -> Float[Tensor, " ahead"]:
    """Go on at the last speed."""
    return torch.cat([arcs, arcs[-1] + (arcs[-1] - arcs[-2]) * torch.arange(1, more + 1)])


def _spread_over(motion: Motion, start: int, frames: int) -> Motion:
    """Put a motion's first frame at `start` of a shot; frames before and after hold its ends."""
    source = (torch.arange(frames) - start).clamp(0, motion.num_frames - 1)
    return replace(
        motion,
        root_position=motion.root_position[source].double(),
        local_quat_xyzw=motion.local_quat_xyzw[source].double(),
    )


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
    error = 100 * (curve.to_curve_axes(walked) - curve.point(track_arcs(curve, walked, start=0.0))).norm(dim=-1)
    worst = int(error.argmax())
    for _, first, stop in true_intervals((error > _PATH_TOLERANCE_CM)[:, None]):
        if first <= worst < stop:
            first, last = float(first / motion.fps), float((stop - 1) / motion.fps)
            return [f"the curve is left by up to {float(error.max()):.0f} cm between {first:.1f} and {last:.1f} s"]
    return []


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
