"""One walk along a curve with its measures and cost: what follow, run and demo have in common."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from controllers.common.character import Character
from controllers.following.follow import FollowSettings, follow
from mapctl import report
from mapctl.curves.curve import Curve
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import PathRequest, SpeedProfile
from mapctl.motion import Motion
from mapctl.problem.solution import Outcome, Solution
from mapctl.runtime.progress import Progress
from mapctl.skeleton import CANONICAL
from mapctl.terms import FootContact
from priors.lstm_gmm.density import LstmGmmDensity


@dataclass(frozen=True, eq=False)
class Walk:
    """A solved walk."""

    request: PathRequest
    """What was asked for."""
    prior: LstmGmmDensity
    """What moved the character."""
    seed: int
    """Seed of everything random."""
    solution: Solution
    """What came out."""
    person: Character | None = None
    """Who walks, where that is not the canonical body."""

    @property
    def on_rig(self) -> Motion:
        """The motion on the rig it was asked for."""
        motion = self.solution.motion
        return motion if self.person is None else self.person.on_rig(motion)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the solve, so that this is the first part of the walk."""
        return self.solution.status.outcome is Outcome.INTERRUPTED

    @cached_property
    def measures(self) -> Mapping[str, float]:
        """Measures of the motion, compared with the curve and the arcs wanted along it."""
        motion = self.solution.motion
        wanted = float(self.request.arcs(motion.num_frames, float(motion.fps))[-1])
        return report.measure_path(motion, self.request.curve, wanted_m=wanted)

    def report(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The report of this walk; `request` is what the user wrote."""
        card = self.prior.card
        prior = {"name": self.prior.name, "licence": card.licence, "quality": card.quality}
        return report.build_report(self.solution, request=request, measures=self.measures, seed=self.seed, prior=prior)

    def summary(self) -> list[str]:
        """A few lines for people."""
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
    person: Character | None = None,
) -> Walk:
    """Solve, for a person of any size. Compiling or loading the fast path, once a process, is not counted."""
    prior.warm_up()
    bones = CANONICAL if person is None else person.skeleton
    settings = None if person is None else FollowSettings(footing=FootContact(rest_height=person.toe_rest_height))
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
    return Walk(request, prior, seed, solution, person)


def parse_follow(curve: Curve, speed: str | float | None, seconds: float | None) -> PathRequest:
    """The wish, checked: RequestError for speeds and durations that make no sense or take too long."""
    profile = SpeedProfile.parse(str(1.2 if speed is None else speed))
    request = PathRequest(curve, profile, seconds)
    request.frames(PRIOR_FPS)
    return request
