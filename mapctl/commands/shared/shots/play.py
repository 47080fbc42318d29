"""Shots solved, measured and reported, for follow and run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.following.follow import FollowSettings
from controllers.shots.planning.way import APART_MARGIN, Way, plan_way
from controllers.shots.request import Others, ShotRequest
from controllers.shots.shot import ShotSettings, ShotSolution, solve_shot
from mapctl import report
from mapctl.commands.shared.licensing import add_licence
from mapctl.commands.shared.shots.plan import ShotPlan
from mapctl.commands.shared.shots.rates import resample_shot
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.problem.solution import Outcome
from mapctl.protocols import Inbetweener
from mapctl.runtime.progress import Progress


@dataclass(frozen=True, eq=False)
class PlayedShot:
    """A solved shot of one actor."""

    plan: ShotPlan
    """What was asked."""
    solution: ShotSolution
    """What came of it, on canonical joints at PRIOR_FPS."""

    @property
    def request(self) -> ShotRequest:
        """Request of the shot."""
        return self.plan.request

    @property
    def on_rig(self) -> Motion:
        """Motion on the actor's rig, at its rate."""
        return self.plan.character.on_rig(resample_shot(self.solution, self.request, self.plan.fps))

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the solve."""
        return self.solution.status.outcome is Outcome.INTERRUPTED

    @cached_property
    def measures(self) -> Mapping[str, float]:
        """Measures of the motion against the way that was planned."""
        way = self.solution.way
        return report.measure_path(self.solution.motion, way.curve, wanted_m=float(way.arcs[-1]))

    def report(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Build the report of this shot; `request` is what the user wrote."""
        card = self.plan.prior.card
        prior = {"name": self.plan.prior.name, "licence": card.licence, "quality": card.quality}
        seed = self.plan.actor.seed
        told = report.build_report(self.solution, request=request, measures=self.measures, seed=seed, prior=prior)
        return add_licence(told)

    def summary(self) -> list[str]:
        """Format a few lines for the user."""
        motion = self.solution.motion
        wishes = [
            f"wish      {wish.name} ({wish.asked}): {wish.got:.1f} {wish.unit}" + ("" if wish.holds else ", NOT HELD")
            for wish in self.solution.wishes
        ]
        return [
            f"motion    {motion.num_frames} frames, {motion.seconds:.1f} s",
            *wishes,
            f"cost      {1000 * self.solution.seconds / motion.num_frames:.1f} ms a frame",
            f"status    {self.solution.status.text}",
        ]


def play_shot(
    plan: ShotPlan,
    earlier: Sequence[PlayedShot],
    inbetweener: Inbetweener,
    *,
    keep_apart: float | None = None,
    progress: Progress | None = None,
) -> PlayedShot:
    """Solve an actor's shot; characters that were solved earlier are walked around."""
    plan.prior.warm_up()
    if keep_apart is not None and earlier:
        tracks = [(one.plan, one.solution.motion.root_position[:, ::2]) for one in earlier]
        plan = replace(plan, request=replace(plan.request, others=_find_others(plan, tracks, keep_apart)))
    follow = FollowSettings().with_rest_height(plan.character.toe_rest_height)

    solution = solve_shot(
        plan.prior,
        inbetweener,
        plan.request,
        generator=torch.Generator().manual_seed(plan.actor.seed),
        settings=ShotSettings(follow=follow),
        skeleton=plan.character.skeleton,
        progress=progress,
    )
    return PlayedShot(plan, solution)


def let_others_pass(plans: Sequence[ShotPlan], keep_apart: float) -> list[ShotPlan]:
    """Return plans in which who is solved first leaves room for later ones that would find no way past: each gives way
    by half. Somebody who has to keep apart from earlier ones does not make room for later ones too."""
    given, tracks = list(plans), list[tuple[ShotPlan, Float[Tensor, "frames 2"]]]()
    for plan in plans:
        others = _find_others(plan, tracks, keep_apart) if tracks else None
        way = plan_way(replace(plan.request, others=others))
        if way.note is not None and others is not None:
            alone = plan_way(plan.request)
            if alone.note is None:
                room = _find_others(given[0], [(plan, _walk_along(alone))], (keep_apart - APART_MARGIN) / 2)
                given[0] = replace(given[0], request=replace(given[0].request, others=replace(room, courtesy=True)))
                way = alone
        tracks.append((plan, _walk_along(way)))
    return given


def _walk_along(way: Way) -> Float[Tensor, "frames 2"]:
    return way.curve.ground_point(way.arcs)


def _find_others(
    plan: ShotPlan, tracks: Sequence[tuple[ShotPlan, Float[Tensor, "frames 2"]]], distance: float
) -> Others:
    """Collect the others' hips from the actor's first frame on; who has not begun stands in the first pose, who has
    ended in the last."""
    hips = []
    longest = max(len(track) for _, track in tracks)
    for one, track in tracks:
        late = round((plan.actor.start_seconds - one.actor.start_seconds) * PRIOR_FPS)
        frames = torch.arange(late, late + longest + abs(late)).clamp(0, len(track) - 1)
        hips.append(track[frames])
    count = min(len(each) for each in hips)
    return Others(torch.stack([each[:count] for each in hips]), distance)
