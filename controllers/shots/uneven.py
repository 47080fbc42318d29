"""Motions found on a flat floor, put onto uneven ground.

Each contact's foothold moves along the direction of travel by as little as the whole foot needs to stand on one plane,
as a tread or a ramp: dynamic programming over all contacts, so that steps stay even. A swing foot takes the shortest
curve over what is between two footholds, and is lifted where it would come too near. Hips follow the mean of what both
feet stand on, and legs reach by inverse kinematics. On a flat floor hips and feet stay.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.shots.footsteps import Footstep
from mapctl import contacts, kinematics, rotations
from mapctl.features import PRIOR_FPS
from mapctl.ground import Ground
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import smooth_between
from mapctl.retarget.character import LEGS, limb_extension
from mapctl.retarget.legs import bend_legs, find_ankles, locate_feet, lower_hips
from mapctl.skeleton import CANONICAL, FEET, TOES, find_heels

STEEPEST = math.radians(15.0)
"""Slope up to which feet are put onto ground as on a flat floor, radians."""
HIGHEST = 0.20
"""Height of a step up to which they are, metres."""
CLEARANCE = 0.03
"""Metres that a swing foot keeps over edges."""
EDGE = 0.03
"""Rise of the ground within 2 cm, metres, that is an edge."""
_TOES_SHARE = 0.3  # of a foot from heel to ball, where a skeleton does not show how long its toes are
_MARGIN, _HALF_WIDTH = 0.02, 0.04  # metres between a sole's ends and an edge, and of half a sole
_LONGER = 0.4  # times that it counts if the ground is uneven under a longer sole than the shortest
_MARGINS = ((-0.06, -0.03), (0.0, 0.0), (0.01, 0.01), (_MARGIN, _MARGIN))  # at heel and tip; a heel may stick out
_FARTHEST, _GRID = 0.4, 0.01  # metres that a foothold is moved by at most, and between those that are tried
_MOVED, _UNEVEN, _TOO_HIGH = 0.1, 0.004, 0.01  # metres that cost the same: moved, of a sole's rest, over HIGHEST
_HIPS_SECONDS, _HEADING_SECONDS = 0.15, 0.3  # over which hips follow the feet, and the direction of travel is the mean
_BENDS_HERTZ = 4.0  # of a swing's trajectory
_AHEAD = 0.15  # metres before a sole in which a riser is looked for
_MOMENTS = 5  # from a frame to the next at which swing feet are measured
_LIFT_ACCELERATION = 30.0  # m/s^2 with which a foot is lifted further at most


class Sole(NamedTuple):
    """Points of a foot's sole, from its toe joint, in the frame of the foot joint, metres."""

    heel: Float[Tensor, "3"]
    ball: Float[Tensor, "3"]
    """Under the toe joint."""
    tip: Float[Tensor, "3"]
    """Tip of straight toes."""

    @staticmethod
    def of(motion: Motion, rest_height: float, foot: int) -> "Sole":
        """Return the sole of a foot whose toe joint rests at a height over the floor, metres."""
        level = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
        ball = level.new_tensor([0.0, -rest_height, 0.0])
        back = (find_heels(motion.skeleton)[foot] - motion.skeleton.offsets[CANONICAL.index(TOES[foot])]) * level
        end = motion.skeleton.end_offsets.get(TOES[foot])
        toes = _TOES_SHARE * back.norm() if end is None else (level.new_tensor(end) * level).norm()
        return Sole(ball + back, ball, ball - torch.nn.functional.normalize(back, dim=0) * toes)

    def points(
        self, toes: Float[Tensor, "frames 3"], turns: Float[Tensor, "frames 4"], up: Float[Tensor, "frames 4"]
    ) -> Float[Tensor, "frames 4 3"]:
        """Return heel, arch, ball and tip of a foot, world, metres, from its toe joint and rotation: toes stay level on
        the slope (the rotation `up`) while the heel is raised."""
        heel, ball, straight = (rotations.rotate(turns, point.expand_as(toes)) for point in self)
        own = rotations.rotate(rotations.inverse(up), straight - ball)
        ahead = torch.nn.functional.normalize(own * own.new_tensor([1.0, 0.0, 1.0]), dim=-1)
        level = rotations.rotate(up, self.ball + ahead * own.norm(dim=-1, keepdim=True))
        tip = torch.where(own[:, 1:2] < 0, level, straight)
        return toes[:, None] + torch.stack([heel, 0.5 * (heel + ball), ball, tip], dim=1)


@dataclass(frozen=True, eq=False)
class Foothold:
    """A contact of a foot, and the plane that it stands on."""

    foot: int
    """0 is left, 1 is right."""
    start: int
    """First frame."""
    stop: int
    """One past the last frame."""
    toe: Float[Tensor, "2"]
    """Toe joint over the flat floor, x and z, metres."""
    moved: Float[Tensor, "2"]
    """By how much it is moved, metres."""
    height: float
    """Height of the plane below the toe joint, metres."""
    gradient: Float[Tensor, "2"]
    """Rise of the plane along x and along z."""
    over_edge: bool
    """Whether the ground under the sole is not one plane."""

    @property
    def up(self) -> Float[Tensor, "4"]:
        """Rotation from the floor to the plane."""
        return find_slope(self.gradient)


@dataclass(frozen=True)
class Footing:
    """How feet stand and swing on uneven ground; metres."""

    clearance: float
    """Lowest height of a swing foot less than 1 cm beyond an edge that it passes; infinite where it passes none."""
    penetration: float
    """Deepest point of a sole in the ground, beyond that over the flat floor."""
    over_edge: int
    """Feet that stand over an edge."""
    steepest: float
    """Steepest slope that a foot stands on, radians."""
    highest: float
    """Highest step from one foothold to the next, beyond the rise of a slope."""
    planted_share: float
    """Share of foot-frames that stand."""
    contact_speed: float
    """Mean speed of toes that stand, m/s."""

    def as_row(self) -> dict[str, float | None]:
        """Return the row of a report, centimetres and degrees."""
        return {
            "edge_clearance_min_cm": 100 * self.clearance if self.clearance < math.inf else None,
            "penetration_max_cm": 100 * self.penetration,
            "feet_over_edge": self.over_edge,
            "slope_max_deg": math.degrees(self.steepest),
            "step_max_cm": 100 * self.highest,
        }

    @property
    def text(self) -> str:
        """One line."""
        over = f"{100 * self.clearance:.1f} cm over edges" if self.clearance < math.inf else "no edge"
        return f"swing {over}, penetration {100 * self.penetration:.1f} cm, {self.over_edge} feet over an edge"

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about what leaves the data of the density, which are of flat floors."""
        found = []
        if self.steepest > STEEPEST + 1e-6:
            found.append(
                f"the ground slopes by {math.degrees(self.steepest):.0f} degrees where a foot stands: people walk"
                f" otherwise from {math.degrees(STEEPEST):.0f} on, and the prior's data are of flat floors"
            )
        if self.highest > HIGHEST + 1e-6:
            found.append(
                f"a step is {100 * self.highest:.0f} cm high: people climb otherwise from {100 * HIGHEST:.0f} cm on,"
                " and the prior's data are of flat floors"
            )
        if self.over_edge:
            found.append(f"soles that stand over an edge: {self.over_edge}; no foothold near enough has room for one")
        return tuple(found)


def find_slope(gradient: Float[Tensor, "2"]) -> Float[Tensor, "4"]:
    """Return the rotation from the floor to a plane that rises so along x and along z."""
    x, z = gradient
    upright = gradient.new_tensor([0.0, 1.0, 0.0])
    return rotations.between_vectors(upright, torch.stack([-x, torch.ones_like(x), -z]))


@dataclass(frozen=True, eq=False)
class SteppedMotion:
    """A motion that was put onto ground."""

    motion: Motion
    """Canonical joints at PRIOR_FPS."""
    flat: Motion
    """The motion over the flat floor."""
    ground: Ground
    soles: Sequence[Sole]
    """Left and right."""
    holds: Sequence[Foothold]
    """Footholds of both feet in the order of their beginnings."""
    tracks: "Sequence[_FootTrack]"
    """Left and right."""

    @property
    def footsteps(self) -> list[Footstep]:
        """Steps from foothold to foothold."""
        steps = [
            Footstep(one.foot, one.stop - 1, other.start, toe=tuple((other.toe + other.moved).tolist()))
            for foot in range(2)
            for one, other in pairwise([hold for hold in self.holds if hold.foot == foot])
        ]
        return sorted(steps, key=lambda step: step.land)

    def lift_swings(self, keys: Sequence[int]) -> "SteppedMotion":
        """Lift swing feet again where they come too near to the ground, but in the frames of `keys`."""
        (toes, feet), (_, flat_feet) = locate_feet(self.motion), locate_feet(self.flat)
        for foot, (track, sole) in enumerate(zip(self.tracks, self.soles, strict=True)):
            own, flat = feet[:, foot], flat_feet[:, foot]
            toes[:, foot] = track.lift(toes[:, foot], own, flat, self.ground, sole, keys)
        ankles = find_ankles(self.motion.skeleton, toes, feet)
        return replace(self, motion=bend_legs(self.motion, ankles, feet))

    def measure_footing(self) -> Footing:
        """Measure how feet stand and swing."""
        (toes, turns), (flat, flat_turns) = locate_feet(self.motion), locate_feet(self.flat)
        clearance, depth, level = math.inf, 0.0, torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
        speeds = list[Tensor]()
        for foot, (sole, track) in enumerate(zip(self.soles, self.tracks, strict=True)):
            points = sole.points(toes[:, foot], turns[:, foot], track.up)
            before = sole.points(flat[:, foot], flat_turns[:, foot], level.expand(len(flat), 4))[..., 1]
            over = points[..., 1] - self.ground.height(points[..., ::2])
            depth = max(depth, float((before.clamp(max=0) - over).max()))
            stays = track.standing[1:] & track.standing[:-1]
            speeds.append(points[:, 2].diff(dim=0).norm(dim=-1)[stays] * PRIOR_FPS)
            swing = _sample_between(points)[~stays]
            edge, highest = _is_near_edge(swing, self.ground)
            passing = edge & (self.ground.height(swing[..., ::2]) > highest - EDGE / 2)
            if bool(passing.any()):
                clearance = min(clearance, float((swing[..., 1] - highest)[passing].min()))
        rises = [
            abs(one.height - other.height)
            - float(max(one.gradient.norm(), other.gradient.norm()) * (one.toe - other.toe).norm())
            for one, other in pairwise(self.holds)
        ]
        return Footing(
            clearance,
            depth,
            sum(hold.over_edge for hold in self.holds),
            math.atan(max(float(hold.gradient.norm()) for hold in self.holds)),
            max(0.0, *rises),
            float(torch.stack([track.standing for track in self.tracks]).double().mean()),
            float(torch.cat(speeds).mean()),
        )


def step_onto_ground(motion: Motion, ground: Ground, rest_height: float, *, keys: Sequence[int] = ()) -> SteppedMotion:
    """Put a motion on the flat floor, canonical joints at PRIOR_FPS with toe joints resting at a height (metres), onto
    the ground. Footholds in the frames of `keys` stay."""
    soles = [Sole.of(motion, rest_height, foot) for foot in range(2)]
    holds = _choose_footholds(_find_footholds(motion), motion, ground, soles, keys)
    flat, flat_turns = locate_feet(motion)
    toes, turns, tracks = [], [], list[_FootTrack]()
    for foot, sole in enumerate(soles):
        own, turn = [hold for hold in holds if hold.foot == foot], flat_turns[:, foot]
        tracks.append(_FootTrack.of(own, flat[:, foot], ground, sole))
        turns.append(rotations.multiply(tracks[-1].up, turn))
        toes.append(tracks[-1].lift(tracks[-1].toe, turns[-1], turn, ground, sole))
    sigma, root, turns = _HIPS_SECONDS * PRIOR_FPS, motion.root_position.double().clone(), torch.stack(turns, dim=1)
    root[:, ::2] += gaussian.smooth(torch.stack([track.moved for track in tracks]).mean(dim=0), sigma)
    root[:, 1] += gaussian.smooth(torch.stack([track.height for track in tracks]).mean(dim=0), sigma)
    ankles = find_ankles(motion.skeleton, torch.stack(toes, dim=1), turns)
    lowered = lower_hips(replace(motion, root_position=root), ankles, limb_extension(motion, LEGS))
    return SteppedMotion(bend_legs(lowered, ankles, turns), motion, ground, soles, holds, tracks)


def _find_footholds(motion: Motion) -> list[Foothold]:
    """Find the contacts of a motion in the order of their beginnings; its first and its last frame are some."""
    toes = motion.joint_positions()[:, list(CANONICAL.indices(TOES))].double()
    planted = contacts.debounced(contacts.detect_contacts(toes, motion.fps))
    planted[[0, -1]] = True
    still = toes.new_zeros(2)
    found = [
        Foothold(foot, start, stop, toes[start:stop, foot, ::2].median(dim=0).values, still, 0.0, still, False)
        for foot, start, stop in true_intervals(planted)
    ]
    return sorted(found, key=lambda hold: hold.start)


def _choose_footholds(
    holds: Sequence[Foothold], motion: Motion, ground: Ground, soles: Sequence[Sole], keys: Sequence[int]
) -> list[Foothold]:
    """Move footholds along the direction of travel: the least sum of squares of how far each is moved, how much farther
    than the one before, how uneven the ground under its sole is, and how much too high it is (Viterbi 1967)."""
    hips = kinematics.heading(motion.local_quat_xyzw[:, 0].double())
    ahead = torch.stack([torch.sin(hips), torch.cos(hips)], dim=-1)
    ahead = torch.nn.functional.normalize(gaussian.smooth(ahead, _HEADING_SECONDS * PRIOR_FPS), dim=-1)
    offsets = torch.arange(-_FARTHEST, _FARTHEST + _GRID / 2, _GRID, dtype=torch.float64)
    feet, found = motion.joint_rotations().double(), []
    for hold in holds:
        middle = (hold.start + hold.stop) // 2
        yaw = rotations.split_heading(feet[middle, CANONICAL.index(FEET[hold.foot])])[0]
        moved = offsets[:, None] * ahead[middle]
        found.append((moved, *fit_planes(hold.toe + moved, yaw, ground, soles[hold.foot])))
    cost, came = torch.zeros_like(offsets), []
    between = ((offsets[:, None] - offsets) / _MOVED).square()
    for number, (_, heights, gradients, uneven, _) in enumerate(found):
        if number:
            _, before, slopes, _, _ = found[number - 1]
            slope = torch.maximum(slopes.norm(dim=-1)[:, None], gradients.norm(dim=-1))
            rise = (heights - before[:, None]).abs() - slope * (holds[number].toe - holds[number - 1].toe).norm()
            high = ((rise - HIGHEST).clamp_min(0) / _TOO_HIGH).square()
            cost, back = (cost[:, None] + between + high).min(dim=0)
            came.append(back)
        is_key = any(holds[number].start <= key < holds[number].stop for key in keys)
        moving = torch.where(offsets.abs() < _GRID / 2, 0.0, math.inf) if is_key else offsets / _MOVED
        cost = cost + moving.square() + (uneven / _UNEVEN).square()
    at, chosen = int(cost.argmin()), []
    for number in range(len(holds) - 1, -1, -1):
        moved, heights, gradients, _, over = (values[at] for values in found[number])
        hold = replace(holds[number], moved=moved, height=float(heights), gradient=gradients, over_edge=bool(over))
        chosen.append(hold)
        at = int(came[number - 1][at]) if number else at
    return chosen[::-1]


def fit_planes(
    toes: Float[Tensor, "n 2"], yaw: Tensor, ground: Ground, sole: Sole
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 2"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Fit planes to the ground under soles with toe joints at points (x, z): heights below these, gradients along x and
    z, and by how much the ground differs from the planes, metres: under the shortest sole, and less so under longer
    ones. Also whether the sole itself is over an edge."""
    found = []
    for heel, tip in _MARGINS:
        along = torch.linspace(float(sole.heel[2]) - heel, float(sole.tip[2]) + tip, 9, dtype=torch.float64)
        aside = along.new_tensor([-_HALF_WIDTH, 0.0, _HALF_WIDTH])
        under = rotations.rotate_ground(torch.cartesian_prod(aside, along), yaw)
        heights = ground.height(toes[:, None] + under)
        axes = torch.cat([torch.ones_like(under[:, :1]), under], dim=-1)
        planes = heights @ torch.linalg.pinv(axes).T
        found.append((planes, (heights - planes @ axes.T).abs().amax(dim=-1), heights.amax(dim=-1)))
    planes, off, highest = (torch.stack(values) for values in zip(*found, strict=True))
    over = off > EDGE / 2  # over an edge a foot stands on what is higher under the shortest sole
    planes = torch.where(over[0, :, None], torch.nn.functional.pad(highest[0, :, None], (0, 2)), planes[0])
    return planes[:, 0], planes[:, 1:], off[0] + _LONGER * off[1:].mean(dim=0), over[1]


@dataclass(frozen=True, eq=False)
class _FootTrack:
    """What is added to a foot's motion over the flat floor, by frame."""

    base: Float[Tensor, "frames 3"]
    """Point below the toe joint on the ground or on the trajectory over it, world, metres."""
    up: Float[Tensor, "frames 4"]
    """Rotation from the floor to the slope."""
    moved: Float[Tensor, "frames 2"]
    """By how much the foot is moved along the ground, evenly from foothold to foothold, metres."""
    height: Float[Tensor, " frames"]
    """Height of its footholds, evenly from one to the next, metres."""
    rest: Float[Tensor, " frames"]
    """Height of the toe joint over the flat floor, metres."""
    swings: Sequence[tuple[int, int]]
    """Frames start to stop of its swings."""
    standing: Bool[Tensor, " frames"]
    """Whether it stands."""

    @staticmethod
    def of(holds: Sequence[Foothold], toe: Float[Tensor, "frames 3"], ground: Ground, sole: Sole) -> "_FootTrack":
        frames, flat = len(toe), toe[:, ::2]
        moved, height, up, bent, back = (toe.new_zeros(frames, width) for width in (2, 1, 4, 3, 3))
        for hold in holds:
            held = slice(hold.start, hold.stop)
            moved[held], up[held] = hold.moved, hold.up
            height[held, 0] = hold.height + (flat[held] - hold.toe) @ hold.gradient
        swings = [(one.stop, other.start) for one, other in pairwise(holds)]
        for one, other in pairwise(holds):
            swing = slice(one.stop, other.start)
            away, clock = other.toe - one.toe, torch.arange(one.stop, other.start)
            if float(away.norm()) > _MOVED:
                share = (flat[swing] - one.toe) @ away / away.square().sum()
            else:
                share = smootherstep((clock - one.stop + 1) / (other.start - one.stop + 1)).to(toe)
            if _is_blocked(one, other, ground, sole):  # a foot that swings farther than it lands would meet a riser
                farthest = share.cummax(dim=0).values
                steady = (farthest / farthest[-1]).clamp_min(0)
                back[swing], share = rotations.lift_ground((steady - share)[:, None] * away), steady
            share = share.clamp(0, 1)
            moved[swing] = torch.lerp(one.moved, other.moved, share[:, None])
            height[swing, 0] = one.height + (other.height - one.height) * share
            up[swing] = rotations.slerp(one.up.expand(len(share), 4), other.up.expand(len(share), 4), share)
            bent[swing] = _stretch_over(one, other, share, ground, sole)
        standing = torch.ones(frames, dtype=torch.bool)
        for start, stop in swings:
            standing[start:stop] = False
        base = smooth_between(bent, standing, hertz=_BENDS_HERTZ, fps=PRIOR_FPS) + back
        base[:, ::2] += flat + moved
        base[:, 1] += height[:, 0]
        return _FootTrack(base, up, moved, height[:, 0], toe[:, 1], swings, standing)

    @property
    def toe(self) -> Float[Tensor, "frames 3"]:
        """Toe joint, before it is lifted."""
        upright = torch.zeros_like(self.base)
        upright[:, 1] = self.rest
        return self.base + rotations.rotate(self.up, upright)

    def lift(
        self,
        toe: Float[Tensor, "frames 3"],
        turns: Float[Tensor, "frames 4"],
        flat_turns: Float[Tensor, "frames 4"],
        ground: Ground,
        sole: Sole,
        keys: Sequence[int] = (),
    ) -> Float[Tensor, "frames 3"]:
        """Return a toe joint, lifted in its swings where the sole would come too near to the ground, but in the frames
        of `keys`."""
        level, upright, lifted = torch.zeros_like(self.up), torch.zeros_like(self.base), toe.clone()
        level[:, 3], upright[:, 1] = 1.0, self.rest
        flat, points = sole.points(upright, flat_turns, level), sole.points(toe, turns, self.up)
        need = _find_need(_sample_between(points), _sample_between(flat)[..., 1], ground)
        need = torch.nn.functional.pad(need, (1, 1), value=-torch.inf).unfold(0, 2, 1).amax(dim=-1)
        for start, stop in self.swings:
            for before, after in pairwise([start - 1, *(key for key in sorted(keys) if start <= key < stop), stop]):
                lifted[before + 1 : after, 1] += _lift_smoothly(need[before + 1 : after])
        return lifted


def _stretch_over(
    one: Foothold, other: Foothold, share: Float[Tensor, " frames"], ground: Ground, sole: Sole
) -> Float[Tensor, "frames 3"]:
    """Return how far the shortest curve from one foothold to another over the ground between them is from the straight
    line, metres, at shares of its length. The ground is as high as its highest point under the sole."""
    begin, end = one.toe + one.moved, other.toe + other.moved
    length = float((end - begin).norm())
    if length < _MOVED:
        return torch.zeros(len(share), 3, dtype=torch.float64)
    ahead = (end - begin) / length
    at = torch.linspace(0, length, max(3, round(length / _GRID)), dtype=torch.float64)
    under = torch.linspace(float(sole.heel[2]) - _MARGIN, float(sole.tip[2]) + _MARGIN, 12, dtype=torch.float64)
    slopes = torch.lerp(one.gradient @ ahead, other.gradient @ ahead, at / length)
    points = begin + (at[:, None] + under)[..., None] * ahead
    over = (ground.height(points) - slopes[:, None] * under).amax(dim=-1)
    straight = torch.lerp(over.new_tensor(one.height), over.new_tensor(other.height), at / length)
    over += torch.where(over > straight + EDGE / 2, CLEARANCE, 0.0)
    over[0], over[-1] = one.height, other.height
    low = float(over.min()) - 1
    beneath = at.new_tensor([[0.0, low], [length, low]])
    hull = scipy.spatial.ConvexHull(torch.cat([torch.stack([at, over], dim=1), beneath]).numpy()).vertices
    knots = np.sort(hull[hull < len(at)])  # from the first to the last over all others
    along, high = at[knots].numpy(), over[knots].numpy()
    arcs = np.concatenate([[0.0], np.hypot(np.diff(along), np.diff(high)).cumsum()])
    forward, up = (share.new_tensor(np.interp(share.numpy() * arcs[-1], arcs, axis)) for axis in (along, high))
    forward, up = forward - share * length, up - torch.lerp(over[0], over[-1], share)
    return torch.stack([forward * ahead[0], up, forward * ahead[1]], dim=-1)


def _is_blocked(one: Foothold, other: Foothold, ground: Ground, sole: Sole) -> bool:
    """Return whether the ground rises in front of a foothold, or of the one before."""
    ahead = torch.nn.functional.normalize(other.toe + other.moved - one.toe - one.moved, dim=0)
    reach = torch.arange(0, float(sole.tip[2]) + _AHEAD, _GRID, dtype=torch.float64)
    rises = [
        ground.height(hold.toe + hold.moved + reach[:, None] * ahead) - hold.height - hold.gradient @ ahead * reach
        for hold in (one, other)
    ]
    return float(torch.stack(rises).max()) > EDGE


def _is_near_edge(points: Float[Tensor, "*batch 3"], ground: Ground) -> tuple[Tensor, Tensor]:
    """Return whether there is an edge within 1 cm of points, and the highest ground there, metres."""
    around = torch.cartesian_prod(*[torch.tensor([-0.01, 0.0, 0.01], dtype=torch.float64)] * 2)
    heights = ground.height(points[..., None, ::2] + around)
    return heights.amax(dim=-1) - heights.amin(dim=-1) > EDGE, heights.amax(dim=-1)


def _sample_between(points: Float[Tensor, "frames 4 3"]) -> Float[Tensor, "steps moments 4 3"]:
    """Sample points at moments from each frame to the next."""
    share = torch.linspace(0, 1, _MOMENTS, dtype=points.dtype)[:, None, None]
    return torch.lerp(points[:-1, None], points[1:, None], share)


def _find_need(
    points: Float[Tensor, "steps moments 4 3"], flat: Float[Tensor, "steps moments 4"], ground: Ground
) -> Float[Tensor, " steps"]:
    """Find by how much a swing foot is too low from frame to frame: it keeps its height over the flat floor up to the
    clearance, and all of that over edges."""
    edge, highest = _is_near_edge(points, ground)
    required = ground.height(points[..., ::2]) + flat.clamp(max=CLEARANCE)
    return (torch.where(edge, highest + CLEARANCE, required) - points[..., 1]).amax(dim=(1, 2))


def _lift_smoothly(need: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Return the smoothest lift, metres, that is as high as needed, from none before and to none after."""
    frames = len(need)
    seconds = torch.minimum(torch.arange(1, frames + 1), torch.arange(frames, 0, -1)) / PRIOR_FPS
    lowest = need.clamp_min(0).minimum(0.5 * _LIFT_ACCELERATION * seconds.square()).numpy()
    if not lowest.any():
        return torch.zeros_like(need)
    bends = np.diff(np.eye(frames + 4), 2, axis=0)[:, 2:-2]
    found = scipy.optimize.lsq_linear(bends, np.zeros(len(bends)), bounds=(lowest, np.inf))
    return need.new_tensor(found.x)
