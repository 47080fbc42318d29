"""Solved walks along curves with their measures and cost, for follow, run and demo."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from controllers.common.character import Character
from controllers.following.follow import FollowSettings, follow
from mapctl import report
from mapctl.commands.shared.licensing import add_licence
from mapctl.curves.curve import Curve
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import USUAL_SPEED, PathRequest, SpeedProfile
from mapctl.motion import Motion
from mapctl.problem.solution import Outcome, Solution
from mapctl.runtime.progress import Progress
from mapctl.skeleton import CANONICAL
from priors.lstm_gmm.density import LstmGmmDensity


@dataclass(frozen=True, eq=False)
class Walk:
    """A solved walk."""

    request: PathRequest
    """Request for the walk."""
    prior: LstmGmmDensity
    """Density of the character's motion."""
    seed: int
    """Seed of everything random."""
    solution: Solution
    """Solution of the request."""
    character: Character | None = None
    """Character that walks, where that is not the canonical body."""

    @property
    def on_rig(self) -> Motion:
        """Motion on the requested rig."""
        motion = self.solution.motion
        return motion if self.character is None else self.character.on_rig(motion)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the solve, so that this is the first part of the walk."""
        return self.solution.status.outcome is Outcome.INTERRUPTED

    @cached_property
    def measures(self) -> Mapping[str, float]:
        """Measures of the motion against the curve and the requested arc along it."""
        motion = self.solution.motion
        wanted = float(self.request.arcs(motion.num_frames, float(motion.fps))[-1])
        return report.measure_path(motion, self.request.curve, wanted_m=wanted)

    def report(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Build the report of this walk; `request` is what the user wrote."""
        card = self.prior.card
        prior = {"name": self.prior.name, "licence": card.licence, "quality": card.quality}
        told = report.build_report(self.solution, request=request, measures=self.measures, seed=self.seed, prior=prior)
        return add_licence(told)

    def summary(self) -> list[str]:
        """Format a few lines for the user."""
        m = {name: "-" if value != value else f"{value:.1f}" for name, value in self.measures.items()}
        cost = report.summarise_timing(self.solution.windows, seconds=self.solution.seconds)
        motion, speed, planted = (self.solution.motion, self.measures["speed_m_s"], self.measures["planted_share"])
        return [
            f"motion    {motion.num_frames} frames, {motion.seconds:.1f} s, {speed:.2f} m/s",
            f"path      error {m['path_error_mean_cm']} cm mean, {m['path_error_max_cm']} max; sway {m['sway_cm']} cm",
            f"progress  {m['travelled_m']} of {m['wanted_m']} m",
            f"feet      planted {planted:.0%} of the time, then moving {m['contact_speed_cm_s']} cm/s",
            f"cost      {cost['frame_ms_p50']:.1f} ms a frame (p99 {cost['frame_ms_p99']:.1f}), "
            f"{cost['evaluations_per_frame']:.1f} evaluations a frame, threads: {cost['threads']}",
            f"status    {self.solution.status.text}",
        ]


def walk(
    prior: LstmGmmDensity,
    request: PathRequest,
    *,
    seed: int,
    progress: Progress | None = None,
    character: Character | None = None,
) -> Walk:
    """Solve a walk for a character of any size. Compiling or loading the fast path, once a process, is not counted."""
    prior.warm_up()
    bones = CANONICAL if character is None else character.skeleton
    settings = None if character is None else FollowSettings().with_rest_height(character.toe_rest_height)
    solution = follow(
        prior,
        request.curve,
        seconds=request.seconds,
        speed=request.profile,
        generator=torch.Generator().manual_seed(seed),
        progress=progress,
        skeleton=bones,
        settings=settings,
    )
    return Walk(request, prior, seed, solution, character)


def parse_follow(curve: Curve, speed: str | float | None, seconds: float | None) -> PathRequest:
    """Parse and check a request: RequestError for speeds and durations that make no sense or take too long."""
    profile = SpeedProfile.parse(str(USUAL_SPEED if speed is None else speed))
    request = PathRequest(curve, profile, seconds)
    request.frames(PRIOR_FPS)
    return request
