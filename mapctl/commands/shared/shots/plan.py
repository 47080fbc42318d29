"""Actors' tables as shots: clips and poses that they name are read, and put on the character's body."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from controllers.common.character import Character
from controllers.shots.clips.arrival import Arrival
from controllers.shots.clips.lead import Lead
from controllers.shots.request import Look, PoseKey, Reach, ShotRequest
from controllers.shots.rest_pose import build_rest_pose
from mapctl.commands.shared.inputs import read_clip
from mapctl.commands.shared.options import ReadOptions
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import USUAL_SPEED, SpeedProfile
from mapctl.intent.shot_keys import ShotKey
from mapctl.intent.timed_speed import TimedSpeed
from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.scene_file import Actor


@dataclass(frozen=True, eq=False)
class ShotPlan:
    """What an actor is asked to do, and on what body."""

    actor: Actor
    """The actor's table."""
    request: ShotRequest
    """Its wishes."""
    prior: LstmGmmDensity
    """Density of its walks."""
    character: Character
    """Its body."""
    fps: Fraction
    """Rate of its motion."""


def plan_shot(
    actor: Actor,
    curve: Curve,
    prior: LstmGmmDensity,
    *,
    character: Character,
    folder: Path,
    options: ReadOptions,
    obstacles: Sequence[Obstacle] = (),
    fps: Fraction | None = None,
) -> ShotPlan:
    """Plan an actor's shot; a clip that it goes on from or ends in is read, and gives it its body and its rate.
    RequestError for wishes that do not fit each other, and for labels that the prior does not know."""
    body = _Body.of(actor, character, folder, options, prior)
    character, placed = body.character, actor.offset is not None or actor.turn_deg is not None
    lead, arrival = None, None
    if actor.start_clip is not None:
        lead = Lead.of(body.read(actor.start_clip[0]), actor.start_clip[1])
        if placed:
            lead = lead.bring_to(curve)
        else:
            curve = lead.bring_curve(curve)
    if actor.end_clip is not None:
        arrival = Arrival.of(body.read(actor.end_clip[0]), actor.end_clip[1])
        if lead is None and not placed and not curve.closed:
            curve = arrival.bring_curve(curve)
    rate = body.rate if fps is None else fps
    keys = [
        (key.at_seconds(float(rate)), round(key.within_frames * PRIOR_FPS / float(rate)), key) for key in actor.keys
    ]
    request = ShotRequest(
        curve,
        _read_speed(actor, curve),
        actor.seconds,
        lead=lead,
        stand_at_start=actor.start == "stand",
        stand_at_end=actor.end == "stand",
        arrival=arrival,
        loop=actor.loop,
        reaches=tuple(
            Reach(when, key.reach, key.hold_seconds, key.tolerance, within) for when, within, key in keys if key.reach
        ),
        looks=tuple(Look(when, key.look_at, key.hold_seconds) for when, _, key in keys if key.look_at is not None),
        poses=tuple(_build_pose_key(body, key, when, within) for when, within, key in keys if key.tells_hips),
        obstacles=tuple(obstacles),
    )
    labels = [f"{group}={value}" for group, value in (("gait", actor.gait), ("style", actor.style)) if value]
    return ShotPlan(actor, request, prior.conditioned_on(labels) if labels else prior, character, rate)


def _read_speed(actor: Actor, curve: Curve) -> SpeedProfile | TimedSpeed:
    if actor.speed_by_time is not None:
        speed = TimedSpeed.parse(actor.speed_by_time)
        if actor.curve is not None and not any(speed.speeds):
            raise RequestError(f"the speed is zero throughout, with a curve of {curve.length:.1f} m to go")
        return speed
    if actor.curve is None:
        return TimedSpeed((0.0,), (0.0,))
    return SpeedProfile.parse(str(USUAL_SPEED if actor.speed is None else actor.speed))


def _build_pose_key(body: "_Body", key: ShotKey, seconds: float, within: int) -> PoseKey:
    pose = None
    if key.pose is not None:
        clip = body.read(key.pose)
        if key.pose_frame >= clip.num_frames:
            raise RequestError(f"{key.pose} has the frames 0:{clip.num_frames}, and a key wants its {key.pose_frame}")
        pose = clip.slice(key.pose_frame, key.pose_frame + 1)
    return PoseKey(
        seconds,
        pose,
        key.place,
        key.height,
        key.facing_deg,
        key.joints,
        key.root_only,
        key.hold_seconds,
        key.tolerance,
        within,
    )


@dataclass(eq=False)
class _Body:
    """The character's body, and clips put on it."""

    character: Character
    """It."""
    rate: Fraction
    """Of the motion that is made."""
    folder: Path
    """That files are relative to."""
    options: ReadOptions
    """How files are read."""
    prior: LstmGmmDensity
    """Whose walkers the canonical body stands like."""
    clips: dict[str, Motion] = field(default_factory=dict)
    """Clips that were read, on canonical joints with the body's bones, by name."""
    rigged: RiggedCharacter | None = None
    """As retargeting takes it, once it is needed."""

    @staticmethod
    def of(actor: Actor, character: Character, folder: Path, options: ReadOptions, prior: LstmGmmDensity) -> "_Body":
        """That of the clip that an actor goes on from or ends in, else the character's."""
        found = _Body(character, Fraction(PRIOR_FPS), folder, options, prior)
        own = actor.start_clip or actor.end_clip
        if own is None:
            return found
        name = own[0]
        clip, rig = read_clip(folder / name, options)
        if character.rigmap is not None and not clip.skeleton.matches(character.rigmap.rig_skeleton):
            raise RequestError(
                f"{name} is of another rig than the character; what goes on from a clip or ends in one is on its rig"
            )
        canonical, body = RiggedCharacter.of(clip, rig)
        found.character = Character(canonical.skeleton, float(body.stance.toe_height.mean()), body.rigmap, body.source)
        found.rate, found.rigged, found.clips[name] = clip.fps, body, canonical
        return found

    def read(self, name: str) -> Motion:
        """Return a clip on canonical joints with this body's bones; RequestError, which names it, for one whose joints
        cannot be identified."""
        if name not in self.clips:
            clip, rig = read_clip(self.folder / name, self.options)
            if self.rigged is None:
                skeleton, height = self.character.skeleton, self.character.toe_rest_height
                standing = self.character.on_rig(build_rest_pose(self.prior, skeleton, height))
                self.rigged = RiggedCharacter.of(standing)[1]
            try:
                self.clips[name] = retarget_motion(clip, self.rigged, rig).motion
            except RequestError as error:
                raise RequestError(f"{name}: {error}") from error
        return self.clips[name]
