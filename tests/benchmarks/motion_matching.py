"""Motion matching along a curve or by commands: what a game would use instead of a density and a solver (Clavet 2016;
features as in Holden et al. 2020, section 3, with the weights of their published demo).

Capture is played; five times a second the frame whose pose is nearest to the one that is played, and whose next second
is nearest to the trajectory ahead, is searched among all, and what jumps then fades (inertialisation, Bollo 2018). The
root goes where the capture goes: nothing pulls it to the curve.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl import rotations
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root, mirror_features
from mapctl.intent.steering import Command, SteeringLimits, SteeringTarget
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.skeleton import CANONICAL

_FEET = CANONICAL.indices(("leftFoot", "rightFoot"))


@dataclass(frozen=True)
class MotionMatchingSettings:
    """Settings of the search: features, interval, and decay of jumps."""

    every: float = 0.2
    """Seconds between searches."""
    ahead: tuple[float, ...] = (1 / 3, 2 / 3, 1.0)
    """Seconds ahead at which trajectories are compared."""
    half_life: float = 0.1
    """Seconds in which half of a jump has faded."""
    foot_positions: float = 0.75
    """Weight of the feet's positions."""
    foot_velocities: float = 1.0
    """Weight of the feet's velocities."""
    hips_velocity: float = 1.0
    """Weight of the hips' velocity."""
    trajectory_positions: float = 1.0
    """Weight of the positions ahead."""
    trajectory_directions: float = 1.5
    """Weight of the headings ahead."""
    starts: int = 20
    """Number of the best matching first frames, of which one is drawn."""


@dataclass(frozen=True, eq=False)
class MotionDatabase:
    """Capture to play, frame after frame, and what frames are compared by."""

    features: Float[ndarray, "frames size"]
    """Frames of all clips in `mapctl.features.LAYOUT`."""
    columns: Float[ndarray, "frames columns"]
    """Features by which frames are compared, each group in units of its spread and times its weight; what is ahead
    means nothing where a clip ends sooner."""
    candidates: ndarray
    """Frames that may be jumped to, (candidates,)."""
    scale: Float[ndarray, " columns"]
    """Weight of each column, from world units."""
    last: ndarray
    """Last frame of each frame's clip, (frames,)."""
    settings: MotionMatchingSettings
    """Builder of the columns."""

    @staticmethod
    def of(
        clips: Sequence[Float[Tensor, "frames size"]], settings: MotionMatchingSettings | None = None
    ) -> "MotionDatabase":
        """Build it from clips as features, each also mirrored; RequestError where none is longer than the search looks
        ahead."""
        settings = settings or MotionMatchingSettings()
        reach = round(max(settings.ahead) * PRIOR_FPS)
        both = [each for clip in clips if len(clip) > reach + 1 for each in (clip, mirror_features(clip))]
        if not both:
            raise RequestError(f"motion matching needs a clip of more than {reach + 1} frames")
        columns = np.concatenate([_describe(clip, settings) for clip in both])
        lengths = np.array([len(clip) for clip in both])
        ends = np.cumsum(lengths) - 1
        last = np.repeat(ends, lengths)
        candidates = np.flatnonzero(np.arange(len(last)) + reach <= last)
        scale = _scale_groups(columns[candidates], settings)
        features = torch.cat(both).float().numpy()
        return MotionDatabase(features, columns * scale, candidates, scale, last, settings)

    @cached_property
    def tree(self) -> "scipy.spatial.KDTree":
        """Index of the candidates by their columns."""
        return scipy.spatial.KDTree(self.columns[self.candidates])

    def look_ahead(self, ahead: GroundPose, ground: GroundPose) -> Float[ndarray, " ahead"]:
        """Describe ground poses ahead of one as the last columns describe what a frame's clip does next."""
        seen = _see(ahead.position_xz, ahead.heading, ground.position_xz, ground.heading)
        return seen.flatten().numpy() * self.scale[-seen.numel() :]


def follow_by_matching(
    database: MotionDatabase, curve: Curve, *, seconds: float, speed: float, generator: torch.Generator
) -> Motion:
    """Follow a curve for so many seconds at a speed, m/s, from its start; returns the motion at PRIOR_FPS."""
    arc, ahead = 0.0, torch.tensor(database.settings.ahead, dtype=torch.float64)

    def lead(frame: int, ground: GroundPose) -> GroundPose:
        nonlocal arc
        arc = float(curve.nearest(ground.position_xz[None], torch.tensor([arc]), reach=0.5)[0]) if frame else 0.0
        arcs = arc + speed * ahead
        return GroundPose(curve.ground_point(arcs), curve.heading(arcs))

    start = GroundPose(curve.ground_point(0.0).double(), torch.tensor(curve.start_heading, dtype=torch.float64))
    return _play(database, lead, start, round(seconds * PRIOR_FPS), generator)


def steer_by_matching(
    database: MotionDatabase, command_at: Callable[[float], Command], *, frames: int, generator: torch.Generator
) -> Motion:
    """Answer commands from the origin on; the trajectory ahead is that of steering targets within their limits."""
    limits, seconds = SteeringLimits(), max(database.settings.ahead)
    first = command_at(0.0)
    target, last = SteeringTarget(first.speed, first.heading, first.hips_heading), 0

    def lead(frame: int, ground: GroundPose) -> GroundPose:
        nonlocal target, last
        command = command_at(frame / PRIOR_FPS)
        if frame > last:
            target, last = target.ahead(command, limits, frames=frame - last, fps=PRIOR_FPS)[-1], frame
        coming = target.ahead(command, limits, frames=round(seconds * PRIOR_FPS), fps=PRIOR_FPS)
        path = ground.position_xz + torch.tensor([each.velocity for each in coming]).double().cumsum(0) / PRIOR_FPS
        at = [round(each * PRIOR_FPS) - 1 for each in database.settings.ahead]
        return GroundPose(path[at], torch.tensor([coming[index].facing for index in at], dtype=torch.float64))

    start = GroundPose(torch.zeros(2).double(), torch.tensor(first.hips_heading, dtype=torch.float64))
    return _play(database, lead, start, frames, generator)


def _play(
    database: MotionDatabase,
    lead: Callable[[int, GroundPose], GroundPose],
    start: GroundPose,
    frames: int,
    generator: torch.Generator,
) -> Motion:
    """Play so many frames from a ground pose; `lead` returns the ground poses ahead of a frame and its own."""
    settings, tree, ground = database.settings, database.tree, start
    playing, played = _choose_start(database, database.look_ahead(lead(0, start), start), generator), []
    fading = _Fading(np.zeros(LAYOUT.continuous), np.zeros(LAYOUT.continuous), 0)
    step = round(settings.every * PRIOR_FPS)
    for number in range(frames):
        if number and (number % step == 0 or playing >= database.last[playing]):
            ahead = database.look_ahead(lead(number, ground), ground)
            wanted = np.concatenate([database.columns[playing, : -len(ahead)], ahead])
            found = int(database.candidates[tree.query(wanted)[1]])
            if found != playing:
                fading = fading.jump(database.features, playing, found, settings)
                playing = found
        values = database.features[playing].astype(np.float64)
        values[: LAYOUT.continuous] += fading.offset(settings)
        played.append(values)
        fading, moved = fading.next(), torch.from_numpy(values)
        ground = ground.displace(
            LAYOUT.pick(moved, "root_displacement_heading"), LAYOUT.pick(moved, "heading_change")[0]
        )
        playing = min(playing + 1, int(database.last[playing]))
    return decode(torch.from_numpy(np.stack(played)), start)


@dataclass(frozen=True, eq=False)
class _Fading:
    """Offset left from the last jump: a critically damped spring from the old motion to the new one."""

    jumped: Float[ndarray, " continuous"]
    """Old values less new ones at the jump."""
    velocity: Float[ndarray, " continuous"]
    """The same of their changes a second."""
    frames: int
    """Frames since the jump."""

    def offset(self, settings: MotionMatchingSettings) -> Float[ndarray, " continuous"]:
        """Compute what is added to the values that are played."""
        damping, seconds = 2 * math.log(2) / settings.half_life, self.frames / PRIOR_FPS
        return math.exp(-damping * seconds) * (self.jumped + (self.velocity + damping * self.jumped) * seconds)

    def next(self) -> "_Fading":
        """Return it a frame later."""
        return _Fading(self.jumped, self.velocity, self.frames + 1)

    def jump(
        self, features: Float[ndarray, "frames size"], playing: int, found: int, settings: MotionMatchingSettings
    ) -> "_Fading":
        """Fade from the frame that would have been played, with what is left of the jump before, to the found one."""
        size = LAYOUT.continuous
        old, new = (features[each, :size].astype(np.float64) for each in (playing, found))
        before, after = (features[max(0, each - 1), :size].astype(np.float64) for each in (playing, found))
        left, left_before = self.offset(settings), _Fading(self.jumped, self.velocity, self.frames - 1).offset(settings)
        velocity = ((old - before) + (left - left_before) - (new - after)) * PRIOR_FPS
        # Steps and turns of the root are changes themselves.
        for block in ("root_displacement_heading", "heading_change"):
            velocity[LAYOUT.slices[block]] = 0.0
        return _Fading(old + left - new, velocity, 0)


def _describe(clip: Float[Tensor, "frames size"], settings: MotionMatchingSettings) -> Float[ndarray, "frames columns"]:
    """Describe each frame from its hips over the ground: feet, their velocities, that of the hips, then positions and
    headings ahead; a clip's last frame stands for what would come after it."""
    origin = GroundPose.origin(torch.float64)
    ground, heading = integrate_root(clip.double(), origin)
    motion = decode(clip.double(), origin)
    positions = motion.joint_positions()
    feet, hips = positions[:, list(_FEET)], positions[:, :1]
    moving = torch.cat([feet, hips], dim=1)
    speeds = moving.diff(dim=0, prepend=moving[:1]) * PRIOR_FPS
    about = feet - rotations.lift_ground(ground)[:, None]
    seen = rotations.rotate_about_y(torch.cat([about, speeds], dim=1), -heading[:, None])
    columns = [seen.flatten(1)]
    for seconds in settings.ahead:
        later = (torch.arange(len(clip)) + round(seconds * PRIOR_FPS)).clamp(max=len(clip) - 1)
        columns.append(_see(ground[later], heading[later], ground, heading))
    return torch.cat(columns, dim=1).numpy()


def _see(
    position: Float[Tensor, "*n 2"], facing: Float[Tensor, "*n"], ground: Tensor, heading: Tensor
) -> Float[Tensor, "*n 4"]:
    """Return a position and a direction (x and z) as they are seen from a ground pose."""
    turn = facing - heading
    seen = rotations.rotate_ground(position - ground, -heading)
    return torch.cat([seen, torch.stack([turn.sin(), turn.cos()], dim=-1)], dim=-1)


def _scale_groups(
    columns: Float[ndarray, "frames columns"], settings: MotionMatchingSettings
) -> Float[ndarray, " columns"]:
    """Return the weight of each column over the mean spread of its group."""
    ahead = [(2, settings.trajectory_positions), (2, settings.trajectory_directions)] * len(settings.ahead)
    groups = [(6, settings.foot_positions), (6, settings.foot_velocities), (3, settings.hips_velocity), *ahead]
    spread, first, scale = columns.std(axis=0), 0, []
    for width, weight in groups:
        scale += [weight / max(1e-6, float(spread[first : first + width].mean()))] * width
        first += width
    return np.array(scale)


def _choose_start(database: MotionDatabase, wanted: Float[ndarray, " ahead"], generator: torch.Generator) -> int:
    """Draw one of the frames whose next second is nearest to that wanted."""
    most = database.settings.starts
    away = np.square(database.columns[database.candidates, -len(wanted) :] - wanted).sum(axis=1)
    best = np.argpartition(away, min(most, len(away) - 1))[:most]
    return int(database.candidates[best[int(torch.randint(len(best), (1,), generator=generator))]])
