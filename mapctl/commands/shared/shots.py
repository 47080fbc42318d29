"""Shots of actors, planned and solved, with their measures and cost, for follow, run and demo."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

import priors
from controllers.common.character import Character
from controllers.shots.footsteps import SIDES, Footstep
from controllers.shots.reaching import build_rest_pose
from controllers.shots.request import Arrival, Lead, Look, Others, PoseKey, Reach, ShotRequest
from controllers.shots.shot import ShotSolution, solve_shot
from controllers.shots.trajectory import APART_MARGIN, Trajectory, plan_trajectory
from controllers.shots.walk import FollowSettings
from mapctl import kinematics, metrics, report
from mapctl.commands.shared.inputs import read_clip
from mapctl.commands.shared.options import ReadOptions
from mapctl.commands.shared.outputs import add_licence
from mapctl.curves import Curve, smooth_path
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.ground import Ground
from mapctl.intent.path import SpeedProfile, TimedSpeed
from mapctl.intent.shot_keys import ShotKey
from mapctl.mesh.primitives import Surface
from mapctl.motion import Motion
from mapctl.problem.solution import Outcome
from mapctl.recording.fusion import resample_by_splines
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.retarget.legs import lower_by
from mapctl.runtime.stepwise import Progress
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.drawn_character import DrawnCharacter
from scenes.overlays import build_hips_mark, build_look_mark, build_obstacle, build_target
from scenes.scene_file import Actor
from scenes.stage import Mark, Shot, Targets


@dataclass(frozen=True, eq=False)
class ShotPlan:
    """An actor's request, and the body that plays it."""

    actor: Actor
    """The actor's table."""
    request: ShotRequest
    """Its constraints and targets."""
    prior: LstmGmmDensity
    """Density of its walks."""
    character: Character
    fps: Fraction
    note: str | None = None
    """Changes to its curve."""


def plan_shot(
    actor: Actor,
    curve: Curve,
    prior: LstmGmmDensity,
    *,
    character: Character,
    folder: Path,
    options: ReadOptions,
    obstacles: Sequence[Obstacle] = (),
    ground: Ground | None = None,
    fps: Fraction | None = None,
) -> ShotPlan:
    """Plan an actor's shot; a clip from which it continues or in which it ends determines its body and its rate.
    RequestError for constraints that do not fit each other, and for labels that the prior does not have."""
    own, rate, rigged = actor.start_clip or actor.end_clip, Fraction(PRIOR_FPS), None
    clips: dict[str, Motion] = {}  # on canonical joints with the character's bones
    if own is not None:
        clip, rig = read_clip(folder / own[0], options)
        if character.rigmap is not None and not clip.skeleton.matches(character.rigmap.rig_skeleton):
            raise RequestError(
                f"{own[0]} is of another rig than the character; a shot from or into a clip is on the rig of the clip"
            )
        canonical, rigged = RiggedCharacter.of(clip, rig)
        toe_height = float(rigged.stance.toe_height.mean())
        character = Character(canonical.skeleton, toe_height, rigged.rigmap, rigged.source)
        rate, clips[own[0]] = clip.fps, canonical

    def read(name: str) -> Motion:
        nonlocal rigged
        if name not in clips:
            clip, rig = read_clip(folder / name, options)
            if rigged is None:
                rest = build_rest_pose(prior, character.skeleton, character.toe_rest_height)
                rigged = RiggedCharacter.of(character.on_rig(rest))[1]
            try:
                clips[name] = retarget_motion(clip, rigged, rig).motion
            except RequestError as error:
                raise RequestError(f"{name}: {error}") from error
        return clips[name]

    curve, note = smooth_path(curve, actor.smooth)
    placed, lead, arrival = actor.offset is not None or actor.turn_deg is not None, None, None
    if actor.start_clip is not None:
        lead = Lead.of(read(actor.start_clip[0]), actor.start_clip[1])
        if placed:
            lead = lead.bring_to(curve)
        else:
            curve = lead.bring_curve(curve)
    if actor.end_clip is not None:
        arrival = Arrival.of(read(actor.end_clip[0]), actor.end_clip[1])
        if lead is None and not placed and not curve.closed:
            curve = arrival.bring_curve(curve)
    rate = fps or rate
    reaches, looks, poses = list[Reach](), list[Look](), list[PoseKey]()
    for key in actor.keys:
        at, within = key.at_seconds(float(rate)), round(key.within_frames * PRIOR_FPS / float(rate))
        if key.reach:
            reaches.append(Reach(at, key.reach, key.hold_seconds, key.tolerance, within))
        if key.look_at is not None:
            looks.append(Look(at, key.look_at, key.hold_seconds))
        if key.gives_hips:
            poses.append(_build_pose_key(key, at, within, read))
    labels = tuple(f"{group}={value}" for group, value in (("gait", actor.gait), ("style", actor.style)) if value)
    request = ShotRequest(
        curve,
        _read_speed(actor, curve),
        actor.seconds,
        lead=lead,
        stand_at_start=actor.start == "stand",
        stand_at_end=actor.end == "stand",
        arrival=arrival,
        loop=actor.loop,
        reaches=tuple(reaches),
        looks=tuple(looks),
        poses=tuple(poses),
        footsteps=tuple(
            Footstep(
                SIDES.index(step.foot),
                round(step.lift_seconds * PRIOR_FPS),
                round(step.land_seconds * PRIOR_FPS),
                toe=step.toe,
            )
            for step in actor.footsteps
        ),
        obstacles=tuple(obstacles),
        labels=labels,
        ground=ground,
    )
    return ShotPlan(actor, request, prior.conditioned_on(labels) if labels else prior, character, rate, note)


def _read_speed(actor: Actor, curve: Curve) -> SpeedProfile | TimedSpeed | None:
    if actor.speed_by_time is not None:
        speed = TimedSpeed.parse(actor.speed_by_time)
        if actor.curve is not None and not any(speed.speeds):
            raise RequestError(f"the speed is zero throughout, with a curve of {curve.length:.1f} m to go")
        return speed
    if actor.curve is None:
        return TimedSpeed((0.0,), (0.0,))
    return None if actor.speed is None else SpeedProfile.parse(str(actor.speed))


def _build_pose_key(key: ShotKey, seconds: float, within: int, read: Callable[[str], Motion]) -> PoseKey:
    pose = None
    if key.pose is not None:
        clip = read(key.pose)
        if key.pose_frame >= clip.num_frames:
            raise RequestError(f"{key.pose} has the frames 0:{clip.num_frames}, and a key wants its {key.pose_frame}")
        pose = clip.slice(key.pose_frame, key.pose_frame + 1)
    same = ("place", "height", "facing_deg", "joints", "root_only", "hold_seconds", "tolerance")
    return PoseKey(seconds, pose, within_frames=within, **{name: getattr(key, name) for name in same})


_BESIDE = 6  # frames after the last
_OF_FLAT_FLOORS = (
    *("skate_cm_s", "skate_ratio", "penetration_cm", "float_cm", "glide_cm", "slide_max_cm", "unsupported_max_s"),
    *("depth_max_cm", "heel_contact_speed_cm_s", "heel_planted_share", "heel_slide_max_cm", "foot_turn_deg_s"),
)


def resample_shot(solution: ShotSolution, request: ShotRequest, fps: Fraction) -> Motion:
    """Resample a shot's motion, a higher rate by splines: through the frames of a clip from which it continues or in
    which it ends, and for a loop through its own, so that its last frame leads into its first at that rate."""
    motion, before, after = solution.motion, None, None
    frames = int((motion.num_frames - 1) * fps / motion.fps) + 1
    if request.lead is not None:
        before = Lead(_raise_to_shot(request.lead.motion, -1, motion, 0, request)).past
    if request.loop:
        frames, after = round(motion.num_frames * fps / motion.fps) or frames, motion.slice(0, _BESIDE)
    elif request.arrival is not None:
        arrival = request.arrival.bring_to(solution.trajectory.curve, float(solution.trajectory.arcs[-1])).motion
        arrival = _raise_to_shot(arrival, 0, motion, -1, request)
        after = arrival.slice(1, min(arrival.num_frames, 1 + _BESIDE))
    if fps <= motion.fps:
        return _join([motion, after]).resample(fps).slice(0, frames)
    whole, first = _join([before, motion, after]), 0 if before is None else before.num_frames
    seconds = (torch.arange(whole.num_frames, dtype=torch.float64) - first) / float(motion.fps)
    return resample_by_splines(whole, seconds, fps=fps, frames=frames)


def _raise_to_shot(clip: Motion, frame: int, motion: Motion, at: int, request: ShotRequest) -> Motion:
    """Raise a clip, on ground, until its hips in one frame are as high as those of a shot's motion in another."""
    if request.ground is None:
        return clip
    return lower_by(clip, (clip.root_position[frame, 1] - motion.root_position[at, 1]).expand(clip.num_frames))


def _join(parts: list[Motion | None]) -> Motion:
    return reduce(Motion.join, (replace(part, moving_offsets={}) for part in parts if part is not None))


@dataclass(frozen=True, eq=False)
class PlayedShot:
    """A solved shot of one actor."""

    plan: ShotPlan
    solution: ShotSolution
    """Its solution, on canonical joints at PRIOR_FPS."""

    @property
    def request(self) -> ShotRequest:
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
        """Measures of the motion against the trajectory that was planned."""
        planned, footing, motion = self.solution.trajectory, self.solution.footing, self.solution.motion
        speed = float(planned.arcs[-1]) / ((motion.num_frames - 1) / float(motion.fps))
        found = metrics.measure(motion, planned.curve, speed=speed)
        if footing is None:
            return found
        own = {"planted_share": footing.planted_share, "contact_speed_cm_s": 100 * footing.contact_speed}
        return {**found, **dict.fromkeys(_OF_FLAT_FLOORS, math.nan), **own}

    def report(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Build the report of this shot; `request` is what the user wrote."""
        card = self.plan.prior.card
        prior = {"name": self.plan.prior.name, "licence": card.licence, "quality": card.quality}
        seed = self.plan.actor.seed
        found = report.build_report(self.solution, request=request, measures=self.measures, seed=seed, prior=prior)
        return add_licence(found)

    def summary(self) -> list[str]:
        m = {name: "-" if value != value else f"{value:.1f}" for name, value in self.measures.items()}
        cost = report.summarise_timing(self.solution.windows, seconds=self.solution.seconds)
        motion, speed, planted = self.solution.motion, self.measures["speed_m_s"], self.measures["planted_share"]
        constraints = [
            f"request   {constraint.name} ({constraint.asked}): {constraint.got:.1f} {constraint.unit}"
            + ("" if constraint.holds else ", NOT HELD")
            for constraint in self.solution.constraints
        ]
        lines = [
            f"motion    {motion.num_frames} frames, {motion.seconds:.1f} s, {speed:.2f} m/s",
            f"path      error {m['path_error_mean_cm']} cm mean, {m['path_error_max_cm']} max; sway {m['sway_cm']} cm",
            f"progress  {m['travelled_m']} of {m['wanted_m']} m",
            f"feet      planted {planted:.0%} of the time, then moving {m['contact_speed_cm_s']} cm/s",
            *([] if self.solution.footing is None else [f"ground    {self.solution.footing.text}"]),
            *constraints,
        ]
        if self.solution.windows:
            took = f"{cost['frame_ms_p50']:.1f} ms a frame (p99 {cost['frame_ms_p99']:.1f})"
            often = f"{cost['evaluations_per_frame']:.1f} evaluations a frame"
            lines.append(f"cost      {took}, {often}, threads: {cost['threads']}")
        return [*lines, f"status    {self.solution.status.text}"]


def play_shot(
    plan: ShotPlan,
    earlier: Sequence[PlayedShot] = (),
    *,
    keep_apart: float | None = None,
    progress: Progress | None = None,
) -> PlayedShot:
    """Solve an actor's shot; characters that were solved earlier are walked around. Compiling or loading the fast path,
    once a process, is not counted."""
    plan.prior.warm_up()
    if keep_apart is not None and earlier:
        tracks = [(one.plan, one.solution.motion.root_position[:, ::2]) for one in earlier]
        plan = replace(plan, request=replace(plan.request, others=_find_others(plan, tracks, keep_apart)))
    settings = FollowSettings(liveliness=plan.actor.liveliness).with_rest_height(plan.character.toe_rest_height)
    solution = solve_shot(
        plan.prior,
        None if plan.request.walks_only else priors.load_inbetweener(),
        plan.request,
        generator=torch.Generator().manual_seed(plan.actor.seed),
        settings=settings,
        skeleton=plan.character.skeleton,
        progress=progress,
    )
    notes = () if plan.note is None else (plan.note,)
    return PlayedShot(plan, replace(solution, status=solution.status.with_notes(notes)))


def let_others_pass(plans: Sequence[ShotPlan], keep_apart: float) -> list[ShotPlan]:
    """Return plans in which actors solved first leave room for later ones that would find no path past: each yields
    by half. An actor that keeps apart from earlier ones does not make room for later ones too."""
    given, tracks = list(plans), list[tuple[ShotPlan, Float[Tensor, "frames 2"]]]()
    for plan in plans:
        others = _find_others(plan, tracks, keep_apart) if tracks else None
        planned = plan_trajectory(replace(plan.request, others=others))
        if planned.blocked and others is not None:
            alone = plan_trajectory(plan.request)
            if not alone.blocked:
                room = _find_others(given[0], [(plan, _walk_along(alone))], (keep_apart - APART_MARGIN) / 2)
                given[0] = replace(given[0], request=replace(given[0].request, others=replace(room, courtesy=True)))
                planned = alone
        tracks.append((plan, _walk_along(planned)))
    return given


def _walk_along(trajectory: Trajectory) -> Float[Tensor, "frames 2"]:
    return trajectory.curve.ground_point(trajectory.arcs)


def _find_others(
    plan: ShotPlan, tracks: Sequence[tuple[ShotPlan, Float[Tensor, "frames 2"]]], distance: float
) -> Others:
    """Collect the others' hips from the actor's first frame on; one that has not begun stands in its first pose, one
    that has ended in the last."""
    hips = []
    longest = max(len(track) for _, track in tracks)
    for one, track in tracks:
        late = round((plan.actor.start_seconds - one.actor.start_seconds) * PRIOR_FPS)
        frames = torch.arange(late, late + longest + abs(late)).clamp(0, len(track) - 1)
        hips.append(track[frames])
    count = min(len(each) for each in hips)
    return Others(torch.stack([each[:count] for each in hips]), distance)


def stage_actor(
    done: PlayedShot, *, colour: str | None = None, start_seconds: float = 0.0, character: DrawnCharacter | None = None
) -> Shot:
    """Return an actor's motion and its targets for the stage: reaches, points to look at, positions and facings of
    the hips, and whole poses. It is drawn as a character if there is one."""
    solution, motion = done.solution, done.solution.motion

    def span(key: Reach | Look) -> tuple[float, float]:
        return key.seconds, key.seconds + key.hold_seconds

    marks = [Mark(build_target(at), span(reach)) for reach in solution.reaches for at in reach.positions.values()]
    marks += [Mark(build_look_mark(look.position), span(look)) for look in done.request.looks]
    for met in solution.met:
        if not met.key.gives_body:
            heading = float(kinematics.heading(met.wanted.local_quat_xyzw[0, 0])) if met.key.gives_facing else None
            marks.append(Mark(build_hips_mark(met.wanted.root_position[0, ::2].numpy(), heading), met.seconds))
    targets = Targets(marks, [met.wanted for met in solution.met if met.key.gives_body])
    drawn = None if character is None else character.put_on(motion)
    return Shot(motion, done.request.curve, colour, start_seconds, targets, drawn)


def build_obstacles(done: Sequence[PlayedShot]) -> list[Surface]:
    """Build every obstacle of some actors once."""
    return [build_obstacle(each) for each in dict.fromkeys(each for one in done for each in one.request.obstacles)]
