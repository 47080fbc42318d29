"""Footsteps: where and when feet stand while a standing body is displaced, or turned, over too little for a walk.

The plan comes before any pose: how many steps, by which foot first, at which footholds. These are discrete choices with
basins of their own, so all plans are compared. Poses follow the plan: toes planted or in swing, hips over the support,
legs by inverse kinematics.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import contacts, kinematics, rotations
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals
from mapctl.retarget.character import HIP_JOINTS, LEGS, limb_lengths
from mapctl.retarget.legs import FREE_EXTENSION, bend_legs, find_ankles, find_missing_length, lower_by
from mapctl.skeleton import CANONICAL, FEET, TOES, leg_length
from mapctl.terms import Keyframe

SIDES = ("left", "right")
"""Names of the feet, in the order of their numbers."""
SWING, BOTH = 13, 4  # frames at PRIOR_FPS of a swing, and of double support before and after it
STEP, _TURN = 0.7, math.radians(75.0)  # of legs' length, and radians, that a foot is put ahead of the other at most
_SLOWEST = 45  # frames of a step at most: where there is more time, there are more steps
_TRACK_STEP = 0.05  # metres between the points of a track
CORNER = 0.04
"""Metres beside a corner of a curve where its directions are."""
_MOVED, _TURNED = 0.02, math.radians(4.0)  # metres and radians from which on a foot is lifted
_NARROWEST = 0.08  # metres between the ankles, sideways: less is a foot that crosses the other


@dataclass(frozen=True)
class Footstep:
    """A swing of one foot to its next foothold: planned, given, or found in a motion."""

    foot: int
    """0 is left, 1 is right."""
    lift: int
    """Last frame, at PRIOR_FPS, in which the foot stands before."""
    land: int
    """First frame in which it stands again."""
    share: float = 1.0
    """Share of a displacement at which a body stands squarely over the foothold."""
    toe: tuple[float, float] = (0.0, 0.0)
    """Toe joint on the foothold, x and z, world, metres."""

    def swing_at(self, clock: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
        """Return the shares of the swing at frames: 0 at its lift, 1 at its landing."""
        return (clock - self.lift) / (self.land - self.lift)

    def as_row(self) -> dict[str, Any]:
        """Return the row of a report: foot, seconds of lift and landing, toe joint."""
        seconds = {"lift_seconds": self.lift / PRIOR_FPS, "land_seconds": self.land / PRIOR_FPS}
        return {"foot": SIDES[self.foot], **seconds, "toe": list(self.toe)}


def find_footsteps(motion: Motion) -> list[Footstep]:
    """Find the steps of a motion at PRIOR_FPS by its contacts."""
    toes, found = motion.joint_positions()[:, list(CANONICAL.indices(TOES))], list[Footstep]()
    for foot, first, stop in true_intervals(~contacts.detect_contacts(toes, motion.fps)):
        if first > 0 and stop < motion.num_frames:
            found.append(Footstep(foot, first - 1, stop, toe=tuple(toes[stop, foot, ::2].tolist())))
    return sorted(found, key=lambda step: step.land)


_HELD, _FOOTHOLD_SIGMA = 6, 0.02  # frames from a landing on, and metres, in which a walk has a toe on a given foothold


def hold_footsteps(steps: Sequence[Footstep], first: int, frames: int, toe_height: float) -> Keyframe:
    """Build the term of given footholds for frames of a shot from `first` on; toes rest at a height, metres."""
    positions = torch.zeros(frames, CANONICAL.num_joints, 3, dtype=torch.float64)
    wanted = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.bool)
    for step in steps:
        toe = CANONICAL.index(TOES[step.foot])
        held = slice(max(0, step.land - first), max(0, step.land + _HELD - first))
        positions[held, toe] = positions.new_tensor([step.toe[0], toe_height, step.toe[1]])
        wanted[held, toe] = True
    return Keyframe(positions, wanted, _FOOTHOLD_SIGMA, name="footholds")


def _ground_pose(pose: Motion) -> Float[Tensor, "3"]:
    return torch.cat([pose.root_position[0, ::2], kinematics.heading(pose.local_quat_xyzw[:, 0])]).double()


@dataclass(frozen=True, eq=False)
class Displacement:
    """A body brought from one stance to another."""

    start: Motion
    """Pose at its start, one frame."""
    stop: Motion
    """Pose at its end, one frame."""
    track: Float[Tensor, "points 3"]
    """Hips along it at even shares: x and z, metres, and heading, radians, without jumps of a turn."""

    @staticmethod
    def between(start: Motion, stop: Motion, path: Float[Tensor, "points 3"] | None = None) -> "Displacement":
        """Displace a body from one pose to another, straight or along a path of ground points and headings at even
        shares, which is moved so that its ends are those of the poses."""
        ends = torch.stack([_ground_pose(pose) for pose in (start, stop)])
        path = ends[:1].expand(2, 3) if path is None else path
        off = ends - path[[0, -1]]
        off[:, 2] = rotations.wrap_angle(off[:, 2])
        off[1, 2] = off[0, 2] + rotations.wrap_angle(off[1, 2] - off[0, 2])
        share = torch.linspace(0, 1, len(path), dtype=path.dtype)
        return Displacement(start, stop, path + torch.lerp(off[0], off[1], share[:, None]))

    @staticmethod
    def along(curve: Curve, arcs: Float[Tensor, "2"], start: Motion, stop: Motion) -> "Displacement":
        """Displace a body along a curve between two arcs, metres."""
        points = max(2, math.ceil(float(arcs[1] - arcs[0]) / _TRACK_STEP) + 1)
        at = torch.lerp(arcs[0], arcs[1], torch.linspace(0, 1, points, dtype=arcs.dtype))
        corner = min(CORNER, float(arcs[1] - arcs[0]) / 2)  # it faces along the curve after one, and before the next
        heading = rotations.unwrap_angle(curve.heading(at.clamp(arcs[0] + corner, arcs[1] - corner)))
        return Displacement.between(start, stop, torch.cat([curve.ground_point(at), heading[:, None]], dim=-1))

    @property
    def moves_feet(self) -> bool:
        """Whether a foot stands elsewhere afterwards."""
        ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
        moved = [self.toes_at(foot, ends)[0][:, ::2].diff(dim=0).norm() for foot in range(2)]
        return float(max(moved)) > _MOVED

    @property
    def distance(self) -> float:
        """Length of the hips' track, metres."""
        return float(torch.diff(self.track[:, :2], dim=0).norm(dim=-1).sum())

    @property
    def turn(self) -> float:
        """Angle that the hips turn by, radians."""
        return float(torch.diff(self.track[:, 2]).abs().sum())

    @property
    def leads_aside(self) -> bool:
        """Whether the hips go to a side rather than ahead or back."""
        aside, ahead = rotations.rotate_ground(self.track[-1, :2] - self.track[0, :2], -self.track[0, 2]).tolist()
        return abs(aside) > abs(ahead)

    def count_steps(self) -> int:
        """Count the steps that it takes at least: the first and the last are half of one between."""
        length = STEP * leg_length(self.start.skeleton)
        return 1 + max(1, math.ceil(self.distance / length - 1e-6), math.ceil(self.turn / _TURN - 1e-6))

    def count_frames(self) -> int:
        """Count the frames at PRIOR_FPS that an unhurried pace takes."""
        return 1 + self.count_steps() * (SWING + BOTH) + BOTH

    def hips_at(self, share: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Interpolate the track at shares."""
        at = share.clamp(0, 1) * (len(self.track) - 1)
        low = at.floor().long().clamp(max=len(self.track) - 2)
        return torch.lerp(self.track[low], self.track[low + 1], (at - low)[:, None])

    def toes_at(self, foot: int, share: Float[Tensor, " n"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
        """Return position of the toe joint and rotation of the foot, world, of one that stands at shares."""
        hips = self.hips_at(share)
        at, turns = [], []
        for pose in (self.start, self.stop):
            positions, quats = pose.joint_positions(), pose.joint_rotations()
            heading = kinematics.heading(pose.local_quat_xyzw[:, 0])
            offset = positions[:, CANONICAL.index(TOES[foot])] - rotations.lift_ground(pose.root_position[:, ::2])
            at.append(rotations.rotate_about_y(offset, -heading))
            turns.append(rotations.multiply(rotations.about_y(-heading), quats[:, CANONICAL.index(FEET[foot])]))
        offset = torch.lerp(at[0], at[1], share[:, None])
        turned = rotations.slerp(turns[0].expand(len(share), 4), turns[1].expand(len(share), 4), share)
        ground = rotations.lift_ground(hips[:, :2])
        return (
            ground + rotations.rotate_about_y(offset, hips[:, 2]),
            rotations.multiply(rotations.about_y(hips[:, 2]), turned),
        )


def plan_footsteps(displacement: Displacement, frames: int) -> list[Footstep]:
    """Plan the steps of a displacement within so many frames at PRIOR_FPS; none where no foot has to move.

    Feet alternate; to a side, one may also follow the other. Of the plans that begin with either foot the one counts
    whose feet are least apart at most, and do not cross: the first is on the side to which the body turns or steps.
    """
    if displacement.distance < _MOVED and displacement.turn < _TURNED:
        return []
    count = max(displacement.count_steps(), frames // _SLOWEST)
    plans = [_lay_steps(first, count, frames) for first in range(2)]
    if displacement.leads_aside:
        plans += [_lay_steps(first, 2 * (count - 1), frames, pairs=True) for first in range(2)]
    plan = min(plans, key=lambda plan: measure_strain(displacement, plan))
    shares = torch.tensor([step.share for step in plan], dtype=torch.float64)
    toes = [displacement.toes_at(foot, shares)[0][:, ::2].tolist() for foot in range(2)]
    return [replace(step, toe=tuple(toes[step.foot][number])) for number, step in enumerate(plan)]


def take_given(steps: Sequence[Footstep], start: int) -> list[Footstep]:
    """Return given steps as the plan of a displacement that begins at a frame; RequestError where a foot has none."""
    if {step.foot for step in steps} != {0, 1}:
        raise RequestError(f"the footsteps at {steps[0].lift / PRIOR_FPS:.2f} s lead to a stand and need both feet")
    return [
        replace(step, lift=step.lift - start, land=step.land - start, share=_share_of(number, len(steps)))
        for number, step in enumerate(sorted(steps, key=lambda step: step.land))
    ]


def _share_of(number: int, count: int) -> float:
    """Return the share of a displacement at which a body stands over a step: the first and the last are half steps."""
    return min(1.0, (number + 1) / max(1, count - 1))


def _lay_steps(first: int, count: int, frames: int, *, pairs: bool = False) -> list[Footstep]:
    """Lay alternating steps; in pairs, the second foot of each comes beside the first."""
    swing = (frames - 1) / (count + (count + 1) * BOTH / SWING)
    both, plan = swing * BOTH / SWING, list[Footstep]()
    for number in range(count):
        lift = both + number * (swing + both)
        share = (number // 2 + 1) / (count // 2) if pairs else _share_of(number, count)
        plan.append(Footstep((first + number) % 2, round(lift), round(lift + swing), share))
    return plan


def measure_strain(displacement: Displacement, plan: Sequence[Footstep]) -> float:
    """Measure the largest distance between feet that stand, metres, and by how much they cross."""
    held = torch.zeros(len(plan), 2, dtype=torch.float64)
    for number, step in enumerate(plan):
        held[number:, step.foot] = step.share
    left, right = (displacement.toes_at(foot, held[:, foot])[0] for foot in range(2))
    other = held[range(len(plan)), [1 - step.foot for step in plan]]
    apart = (left - right)[:, ::2]
    aside = rotations.rotate_ground(apart, -displacement.hips_at(other)[:, 2])[:, 0]
    return float((apart.norm(dim=-1) + 4 * (_NARROWEST - aside).clamp_min(0)).max())


_CLEARANCE = 0.035  # metres of the toe in mid-swing over its rest height, as of walking people (see terms.Clearance)
_TOE_OFF, _TOE_OFF_METRE = math.radians(35.0), math.radians(60.0)  # pitch of a foot as it leaves, at most and per metre
_ROLL = 6  # frames over which a heel rises while the toe stands, where there are as many
_SWAY = 0.02  # metres by which hips go aside to the foot that stands
_SMOOTH = 3.0  # frames (sigma) over which hips follow their support


def take_steps(displacement: Displacement, plan: Sequence[Footstep], frames: int) -> Motion:
    """Pose a body that follows a plan: the first frame is the displacement's start, the last its stop.

    The last step of each foot leads to the stop's stance. Hips are over the mean of both feet, and somewhat to the one
    that stands; they are as high as before and after, but lower where a leg would be stretched. Trunk and arms go from
    one pose to the other.
    """
    start, stop = displacement.start, displacement.stop
    clock = torch.arange(frames, dtype=torch.float64)
    toes, turns, share, sways = [], [], torch.zeros_like(clock), torch.zeros_like(clock)
    for foot in range(2):
        steps, held, swings = [step for step in plan if step.foot == foot], 0.0, list[Swing]()
        stands = displacement.toes_at(foot, torch.tensor([0.0, *(step.share for step in steps)], dtype=torch.float64))
        for step, position, turn in zip(steps, stands[0][1:], stands[1][1:], strict=True):
            if step is not steps[-1]:
                position = position.new_tensor([step.toe[0], float(position[1]), step.toe[1]])
            swings.append(Swing(step, position, turn))
            share = share + 0.5 * (step.share - held) * smootherstep(step.swing_at(clock))
            sways, held = sways + sway_from(step, clock), step.share
        position, turn = swing_foot(clock, stands[0][0], stands[1][0], swings)
        toes.append(position)
        turns.append(turn)
    hips, weight = displacement.hips_at(_smooth_between(share)), smootherstep(clock / (frames - 1))
    body = pose_hips(start, stop, hips, _smooth_between(sways), weight)
    return stand_on(body, torch.stack(toes, dim=1), torch.stack(turns, dim=1))


def sway_from(step: Footstep, clock: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Return how far hips go aside to the foot that stands during a step, metres; to the left where positive."""
    return (-_SWAY if step.foot == 0 else _SWAY) * torch.sin(math.pi * step.swing_at(clock).clamp(0, 1)).square()


def pose_hips(
    start: Motion, stop: Motion, hips: Float[Tensor, "frames 3"], sways: Tensor, weight: Float[Tensor, " frames"]
) -> Motion:
    """Pose a body with its hips at ground positions and headings, and aside of them by `sways`, metres; height and
    joints go from one pose to another by weights."""
    aside = rotations.rotate_ground(torch.stack([sways, 0 * sways], dim=-1), hips[:, 2])
    height = torch.lerp(start.root_position[:, 1], stop.root_position[:, 1], weight)
    root = torch.stack([hips[:, 0] + aside[:, 0], height, hips[:, 1] + aside[:, 1]], dim=-1)
    first, last = (_without_heading(pose).expand(len(hips), -1, 4) for pose in (start, stop))
    quats = rotations.slerp(first, last, weight[:, None].expand(first.shape[:2]))
    quats = torch.cat([rotations.multiply(rotations.about_y(hips[:, 2]), quats[:, 0])[:, None], quats[:, 1:]], dim=1)
    return replace(start, root_position=root, local_quat_xyzw=quats)


@dataclass(frozen=True, eq=False)
class Swing:
    """A step as a foot takes it."""

    step: Footstep
    position: Float[Tensor, "3"]
    """Toe joint on the foothold, world, metres."""
    turn: Float[Tensor, "4"]
    """Rotation of the foot there, world."""
    velocity: Float[Tensor, "3"] | None = None
    """Velocity of a toe that is in the air already, m/s; None of a foot that stands, and whose heel rises first."""


def swing_foot(
    clock: Float[Tensor, " frames"], toe: Float[Tensor, "3"], turn: Float[Tensor, "4"], swings: Sequence[Swing]
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames 4"]]:
    """Swing a foot from where it stands along its steps; return position of the toe joint and rotation of the foot.

    The toe takes a path of minimum jerk (Flash and Hogan 1985) and clears the ground; the heel rises before it leaves.
    """
    toes, turns, pitch = toe.expand(len(clock), 3), turn.expand(len(clock), 4), torch.zeros_like(clock)
    for swing in swings:
        share, step = swing.step.swing_at(clock).clamp(0, 1), swing.step
        velocity = torch.zeros(3, dtype=clock.dtype) if swing.velocity is None else swing.velocity.to(clock)
        path = _swing_to(toe, velocity * (step.land - step.lift) / PRIOR_FPS, swing.position, share)
        height = _clear_ground(path[:, 1], torch.lerp(toe[1], swing.position[1], smootherstep(share)), share)
        toes = torch.where((share > 0)[:, None], torch.stack([path[:, 0], height, path[:, 2]], dim=-1), toes)
        turns = rotations.slerp(turns, swing.turn.expand(len(clock), 4), smootherstep(share))
        if swing.velocity is None:
            roll = min(_ROLL, step.lift - int(clock[0]))
            rise = (clock - step.lift + roll) / (roll + 0.6 * (step.land - step.lift))
            most = min(_TOE_OFF, _TOE_OFF_METRE * float((swing.position - toe).norm()))
            pitch = torch.maximum(pitch, most * torch.sin(math.pi * rise.clamp(0, 1)).square())
        toe = swing.position
    down = torch.stack([pitch, 0 * pitch, 0 * pitch], dim=-1)
    return toes, rotations.multiply(turns, rotations.from_rotation_vector(down))


def _swing_to(
    begin: Float[Tensor, "3"], velocity: Float[Tensor, "3"], end: Float[Tensor, "3"], share: Float[Tensor, " frames"]
) -> Float[Tensor, "frames 3"]:
    """Go from one point, at a velocity per unit of the share, to rest at another, from no acceleration."""
    share, away = share[:, None], end - begin
    third, fourth, fifth = 10 * away - 6 * velocity, -15 * away + 8 * velocity, 6 * away - 3 * velocity
    return begin + share * (velocity + share**2 * (third + share * (fourth + share * fifth)))


def _clear_ground(
    height: Float[Tensor, " frames"], rest: Float[Tensor, " frames"], swing: Float[Tensor, " frames"]
) -> Float[Tensor, " frames"]:
    """Bring a toe's heights, metres, over the clearance of its swing, by a smooth maximum of both."""
    window = torch.sin(math.pi * swing).square()
    short = rest + _CLEARANCE * window - height
    return height + 0.5 * (short + (short.square() + (0.5 * _CLEARANCE * window).square()).sqrt())


def _without_heading(pose: Motion) -> Float[Tensor, "1 joints 4"]:
    quats = pose.local_quat_xyzw.double().clone()
    quats[:, 0] = rotations.split_heading(quats[:, 0])[1]
    return quats


def _smooth_between(values: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Smooth over time; the first and the last value stay."""
    smooth = gaussian.smooth(values[:, None], _SMOOTH)[:, 0]
    weight = torch.linspace(0, 1, len(values), dtype=values.dtype)
    return smooth + (1 - weight) * (values[0] - smooth[0]) + weight * (values[-1] - smooth[-1])


def stand_on(motion: Motion, toes: Float[Tensor, "frames 2 3"], turns: Float[Tensor, "frames 2 4"]) -> Motion:
    """Bring the feet of a motion to positions of the toe joints and rotations in the world; hips go lower where a leg
    does not reach, but for the first and the last frame."""
    ankles = find_ankles(motion.skeleton, toes, turns)
    at_ends = (ankles - motion.joint_positions()[:, HIP_JOINTS])[[0, -1]].norm(dim=-1).amax(dim=0)
    straight = (at_ends / limb_lengths(motion.skeleton, LEGS)).clamp_min(FREE_EXTENSION)
    lower = find_missing_length(motion, ankles, straight)[0].clamp_min(0).amax(dim=1)
    lower = torch.nn.functional.max_pool1d(lower[None], 9, 1, 4)[0]
    lower[[0, -1]] = 0.0
    return bend_legs(lower_by(motion, _smooth_between(lower)), ankles, turns)


_FASTEST_LANDING = 7  # frames that a swing under way still takes at least
AIRBORNE = 0.5  # m/s of a toe, from which on it is in its swing
_AHEAD = 1.9  # times that a swing under way takes longer than at its speed, so that it ends at rest


@dataclass(frozen=True, eq=False)
class LastSteps:
    """The steps of a walk that comes to a stand: the swing that is under way, and the other foot beside it."""

    motion: Motion
    """Walk up to frame `start`, stand from `stop` on; between them the body is given, and feet are not."""
    start: int
    """Last frame of the walk."""
    stop: int
    """First frame of the stand."""

    def plan(self) -> list[Footstep]:
        """Plan both steps: the foot that swings, or the one behind, lands; then the other one follows."""
        toes, speeds = self._toes, self._velocities.norm(dim=-1)
        away = (toes[self.stop] - toes[self.start]).norm(dim=-1)
        first = int(speeds.argmax()) if float(speeds.max()) > AIRBORNE else int(away.argmax())
        swing = SWING
        if float(speeds[first]) > AIRBORNE:
            swing = round(_AHEAD * float(away[first] / speeds[first]) * PRIOR_FPS)
            swing = max(_FASTEST_LANDING, min(SWING, swing))
        landed = min(self.start + swing, self.stop - 2)
        last = min(self.stop, landed + 1 + SWING)
        steps = [Footstep(first, self.start, landed), Footstep(1 - first, landed + 1, last)]
        ground = toes[self.stop][:, ::2].tolist()
        return [replace(step, toe=tuple(ground[step.foot])) for step in steps if float(away[step.foot]) > _MOVED]

    def measure_strain(self) -> float:
        """Measure by how much the steps are longer than comfortable, metres: the first foot ahead of the other one, and
        how far that has to swing; going backward counts too."""
        plan, toes = self.plan(), self._toes[..., ::2]
        if not plan:
            return 0.0
        first, (begin, end) = plan[0].foot, (toes[self.start], toes[self.stop])
        most = STEP * leg_length(self.motion.skeleton)
        travel = self.motion.root_position[self.stop, ::2] - self.motion.root_position[self.start, ::2]
        ahead = torch.nn.functional.normalize(travel, dim=0)
        back = float(((begin - end) @ ahead).clamp_min(0).sum())
        apart, swing = ((end[foot] - begin[1 - first]).norm() for foot in (first, 1 - first))
        return back + max(0.0, float(apart) - most) + max(0.0, float(swing) - most)

    def take(self) -> Motion:
        """Bring the feet along the steps; hips go lower where a leg does not reach."""
        clock = torch.arange(self.start, self.stop + 1, dtype=torch.float64)
        rotation, plan, toes, turns = self.motion.joint_rotations(), self.plan(), [], []
        for foot in range(2):
            begin, end = (self._toes[at, foot] for at in (self.start, self.stop))
            first, last = (rotation[at, CANONICAL.index(FEET[foot])] for at in (self.start, self.stop))
            step = next((step for step in plan if step.foot == foot), None)
            if step is None:  # it stands where it is to stand, but for a little
                share = smootherstep((clock - self.start) / (self.stop - self.start))
                toe = torch.lerp(begin, end, share[:, None])
                turn = rotations.slerp(first.expand(len(clock), 4), last.expand(len(clock), 4), share)
            else:
                velocity = self._velocities[foot] if step.lift == self.start else None
                toe, turn = swing_foot(clock, begin, first, [Swing(step, end, last, velocity)])
            toes.append(toe)
            turns.append(turn)
        return stand_on(self.motion.slice(self.start, self.stop + 1), torch.stack(toes, 1), torch.stack(turns, 1))

    @property
    def _toes(self) -> Float[Tensor, "frames 2 3"]:
        return self.motion.joint_positions()[:, list(CANONICAL.indices(TOES))]

    @property
    def _velocities(self) -> Float[Tensor, "2 3"]:
        """Velocities of the toes in the walk's last frame, m/s."""
        return (self._toes[self.start] - self._toes[self.start - 1]) * PRIOR_FPS
