"""Retarget the motion of a person to a robot: base and joint angles of all frames of a window as one MAP problem.

The motion is first carried to the robot's bones as if its joints were free: in scale, with planted feet, and hands that
keep their relations (`mapctl.retarget.carry`). What is found there is observed, each part with an error of its own:
base and chest, hands and feet, loosely elbows and knees. The tip of a sole that stands is observed almost without
error, at one point of the floor, and so is the foot's orientation while its heel is down. Squared third differences are
the prior of smooth motion.

Gauss's and Newton's method on the banded system of all frames, damped (Levenberg 1944; Marquardt 1963), finds the
angles. Limits of joints hold in each step: angles at a limit are fixed where the gradient leads beyond (projected
Newton, Bertsekas 1982). Speeds beyond a joint's are penalised, and what is left of them is cut in the end.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.kinematics.moving import rotate_world
from mapctl.motion import Motion
from mapctl.retarget import as_rig, load_rig, to_canonical
from mapctl.retarget.carry import Changes, find_ground, retarget_motion
from mapctl.retarget.character import FEET, TOES
from mapctl.retarget.hands import Spans
from mapctl.retarget.rigs import Rig
from mapctl.robots.model import Robot
from mapctl.skeleton import CANONICAL

_TO_ROBOT = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)  # from Y up and Z ahead to Z up and X ahead
_POSITION_ERRORS = {"hips": 0.03, "LowerLeg": 0.05, "Foot": 0.01, "LowerArm": 0.05, "Hand": 0.02}
"""Errors of observed positions, metres (standard deviation), by joint on either side."""
_ORIENTATION_ERRORS = {"hips": 0.1, "chest": 0.15, "head": 0.2, "Foot": 0.15, "Hand": 0.4}
"""Errors of observed orientations, radians."""
_STANDING_ERROR, _FLAT_ERROR = 0.0001, 0.02  # metres of the tip of a sole that stands, radians of a foot that is flat
_SUNK_ERROR = 0.003  # metres by which corners of soles are under the floor
_SOLE_DOWN, _LEVEL = 0.5, 0.9  # least cosine between the vertical and a foot that stands, and one that is flat
_HEEL_METRES = 0.015  # over its height on a flat foot, within which an ankle's heel is down
_ANGLE_ERROR = 1.0  # radians by which joints are away from zero, if nothing shows it
_JERKS = (40.0, 1000.0, 2000.0)  # of the base's position, m/s^3, and orientation, and of joints, rad/s^3
_SPEED_ERROR, _SPEED_SHARE = 1e-3, 0.98  # radians a frame beyond that share of a joint's largest speed
_STIFF = 1e12  # weight that holds a joint at its limit
_ITERATIONS, _LONGEST_STEP, _CONVERGED = 30, 0.5, 1e-4  # of the search; radians or metres; share of the cost
_WINDOW, _OVERLAP, _HELD = 600, 30, 10  # frames that are solved at once; solved again; and of these the first, held


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Base and joint angles of a robot over time."""

    robot: Robot
    fps: Fraction
    position: Float[Tensor, "frames 3"]
    """Position of the base, metres, Z up."""
    orientation: Float[Tensor, "frames 3 3"]
    """Orientation of the base."""
    angles: Float[Tensor, "frames joints"]
    """Joint angles, radians."""
    contacts: Bool[Tensor, "frames 2"]
    """Whether the left and the right foot stand."""

    def slice(self, start: int, stop: int | None) -> "RobotMotion":
        """Return frames start to stop."""
        tracks = {name: getattr(self, name)[start:stop] for name in _TRACKS}
        return replace(self, **tracks)

    def join(self, after: "RobotMotion") -> "RobotMotion":
        """Return this motion with another one after it."""
        return replace(self, **{name: torch.cat([getattr(self, name), getattr(after, name)]) for name in _TRACKS})

    def to_motion(self) -> Motion:
        """Return the links' motion, Y up, whose rig is that of the robot."""
        local = self.robot.rotate_links(self.orientation, self.angles)
        quats = rotations.make_sign_continuous(rotations.from_matrix(local))
        return rotate_world(Motion(self.robot.skeleton, self.fps, self.position, quats), rotations.inverse(_TO_ROBOT))

    @staticmethod
    def of(motion: Motion, robot: Robot) -> "RobotMotion | None":
        """Return a motion of the robot's own links, Y up, as `to_motion` has it; None if its hinges do not allow it."""
        own = rotate_world(motion, _TO_ROBOT)
        local = rotations.to_matrix(own.local_quat_xyzw)
        turned = rotations.to_rotation_vector(own.local_quat_xyzw[:, list(robot.hinges)])
        angles, stand = (turned * robot.axes).sum(dim=-1), torch.zeros(own.num_frames, 2, dtype=torch.bool)
        if not torch.allclose(robot.rotate_links(local[:, 0], angles), local, atol=1e-6):
            return None
        return RobotMotion(robot, motion.fps, own.root_position, local[:, 0], angles, stand).detect_contacts()

    def chain_links(self) -> tuple[Float[Tensor, "frames links 3"], Float[Tensor, "frames links 3 3"]]:
        """Compute positions of all links in the world, metres, and their orientations."""
        at, world = self.robot.chain_links(self.orientation, self.angles)
        return at + self.position[:, None], world

    def find_points(self, links: Sequence[int], points: Float[Tensor, "points 3"]) -> Float[Tensor, "frames points 3"]:
        """Find points that are fixed to links, given about the links' origins, metres."""
        at, world = self.chain_links()
        return at[:, links] + (world[:, links] @ points[..., None])[..., 0]

    def find_tips(self) -> Float[Tensor, "frames 2 3"]:
        """Find the tips of the left and the right sole, metres."""
        return self.find_points(self.robot.feet, self.robot.tips)

    def detect_contacts(self) -> "RobotMotion":
        """Return the motion with feet that stand where the tips of their soles are low and slow."""
        upright = self.find_tips()[..., [1, 2, 0]]
        return replace(self, contacts=contacts.detect_contacts(upright, self.fps))


_TRACKS = ("position", "orientation", "angles", "contacts")


@dataclass(frozen=True, eq=False)
class Observations:
    """Points and orientations that links are to have, with weights: inverse squared errors."""

    links: list[int]
    points: Float[Tensor, "observed 3"]
    """The point of each link, about its origin, metres."""
    positions: Float[Tensor, "frames observed 3"]
    position_weights: Float[Tensor, "frames observed"]
    orientations: Float[Tensor, "frames observed 3 3"]
    orientation_weights: Float[Tensor, "frames observed"]
    standing: Bool[Tensor, "frames 2"]

    @property
    def tips(self) -> list[int]:
        """Which of the observed points are the tips of the left and the right sole."""
        return [number for number, point in enumerate(self.points) if point.any()]

    def slice(self, start: int, stop: int) -> "Observations":
        """Return frames start to stop."""
        names = ("positions", "position_weights", "orientations", "orientation_weights", "standing")
        return replace(self, **{name: getattr(self, name)[start:stop] for name in names})


def retarget_to_robot(motion: Motion, robot: Robot, rig: Rig | None = None) -> tuple[RobotMotion, Changes]:
    """Find the angles with which a robot moves as a person does, at the motion's frame rate; also return how the motion
    changed for the robot's bones. `rig` is the motion's, where it is not the one that would be recognised. A motion of
    the robot's own links, Y up, is returned as it is."""
    if motion.skeleton.matches(robot.skeleton):
        if (own := RobotMotion.of(motion, robot)) is not None:
            return own, Changes()
        motion, rig = to_canonical(motion, replace(as_rig(robot.rigmap), up="y"))[0], load_rig("canonical")
    carried = retarget_motion(motion, robot.character, rig)
    seen = observe(carried.motion, robot)
    done, stop = None, 0
    while stop < motion.num_frames:
        start, held = max(0, stop - _OVERLAP), min(_HELD, stop)
        stop = min(motion.num_frames, start + _WINDOW)
        part = start_search(robot, seen.slice(start, stop), motion.fps)
        if done is not None:
            part = done.slice(start, done.angles.shape[0]).join(part.slice(_OVERLAP, stop - start))
        part = minimise(part, seen.slice(start, stop), held)
        done = part if done is None else done.slice(0, start).join(part)
    assert done is not None
    return _cut_speeds(done), carried.changes


def observe(own: Motion, robot: Robot) -> Observations:
    """Observe links in a motion on the robot's bones, canonical joints, Y up."""
    joints, tpose = robot.rigmap.joints, robot.rigmap.tpose_quat_xyzw
    trunk = next(name for name in ("chest", "spine", "hips") if name in joints)
    down = _TO_ROBOT.expand(own.num_frames, CANONICAL.num_joints, 4)
    turned, at = own.joint_rotations(), rotations.rotate(down, own.joint_positions())
    spans, raised = find_ground(own, robot.character.stance)
    feet = [_Foot.of(own, robot, side, spans[side]) for side in (0, 1)]
    origin = torch.zeros(3, dtype=torch.float64)
    rows: list[tuple[int, Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    for joint, name in enumerate(CANONICAL.names):
        frame = trunk if name == "chest" else name
        part = name.removeprefix("left").removeprefix("right")
        errors = [table.get(part, math.inf) for table in (_POSITION_ERRORS, _ORIENTATION_ERRORS)]
        link = joints.get(frame)
        fixed = name == "head" and link is not None and not (robot.above[link] & ~robot.above[joints[trunk]]).any()
        if link is None or errors == [math.inf, math.inf] or fixed:
            continue
        weight, turn_weight = (torch.full((own.num_frames,), error**-2, dtype=torch.float64) for error in errors)
        orientation, moved = _orient(turned[:, joint], tpose[CANONICAL.names.index(frame)]), origin
        if part == "Foot":
            side = FEET.index(joint)
            foot, flatly = feet[side], _orient(rotations.about_y(feet[side].heading), tpose[joint])
            orientation = torch.where(foot.flat[:, None, None], flatly, orientation)
            turn_weight = torch.where(foot.flat, _FLAT_ERROR**-2, turn_weight)
            moved = foot.hold(at[:, TOES[side]], raised[:, side])
            tip_weight = torch.where(foot.stands, _STANDING_ERROR**-2, weight)
            rows.append((link, robot.tips[side], at[:, TOES[side]] + moved, tip_weight, orientation, turn_weight))
            weight, turn_weight = torch.where(foot.stands, 0.0, weight), torch.zeros_like(turn_weight)
        rows.append((link, origin, at[:, joint] + moved, weight, orientation, turn_weight))
    links, points, *tracks = zip(*rows, strict=True)
    positions, position_weights, orientations, orientation_weights = (torch.stack(track, dim=1) for track in tracks)
    standing = torch.stack([foot.stands for foot in feet], dim=1)
    return Observations(
        list(links), torch.stack(points), positions, position_weights, orientations, orientation_weights, standing
    )


def _orient(quats: Float[Tensor, "frames 4"], tpose: Float[Tensor, "4"]) -> Float[Tensor, "frames 3 3"]:
    """Return a link's orientations, Z up, from those of its canonical joint (xyzw), Y up."""
    return rotations.to_matrix(
        rotations.multiply(_TO_ROBOT.expand_as(quats), rotations.multiply(quats, tpose.expand_as(quats)))
    )


@dataclass(frozen=True, eq=False)
class _Foot:
    """How one foot stands."""

    spans: Spans
    """Where its sole is down."""
    stands: Bool[Tensor, " frames"]
    flat: Bool[Tensor, " frames"]
    """Whether it stands with its heel down."""
    heading: Float[Tensor, " frames"]
    """Radians; constant where it is flat."""

    @staticmethod
    def of(own: Motion, robot: Robot, side: int, touching: Spans) -> "_Foot":
        turns, positions = own.joint_rotations()[:, FEET[side]], own.joint_positions()
        upward = rotations.rotate(turns, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))[:, 1]
        spans = [(start, stop) for start, stop in touching if float(upward[start:stop].mean()) > _SOLE_DOWN]
        stands = torch.zeros(own.num_frames, dtype=torch.bool)
        heading = rotations.unwrap_angle(rotations.split_heading(turns)[0])
        height = (
            positions[:, FEET[side], 1] - positions[:, TOES[side], 1] + robot.rigmap.skeleton.offsets[TOES[side], 1]
        )
        flat = (upward > _LEVEL) & (height < _HEEL_METRES)
        for start, stop in spans:
            stands[start:stop] = True
            lies = flat[start:stop]
            if lies.any():
                heading[start:stop] = heading[start:stop][lies].mean()
        return _Foot(spans, stands, flat & stands, heading)

    def hold(self, tips: Float[Tensor, "frames 3"], floor: Float[Tensor, " frames"]) -> Float[Tensor, "frames 3"]:
        """Return by how much tips have to move, Z up, to be at one point of the floor while they stand, and go evenly
        from one stance to the next."""
        moved = torch.zeros_like(tips)
        for start, stop in self.spans:
            held = tips[start:stop].mean(dim=0)
            held[2] = floor[start]
            moved[start:stop] = held - tips[start:stop]
        if self.spans:
            frames, known = np.arange(len(tips)), self.stands.nonzero()[:, 0].numpy()
            tracks = [np.interp(frames, known, moved[known, axis].numpy()) for axis in range(3)]
            moved = torch.from_numpy(np.stack(tracks, axis=1))
        return moved


def start_search(robot: Robot, seen: Observations, fps: Fraction) -> RobotMotion:
    """Return the start of a search: the base as observed, all joints at zero."""
    angles = torch.zeros(len(seen.positions), len(robot.joints), dtype=torch.float64).clamp(robot.low, robot.high)
    return RobotMotion(robot, fps, seen.positions[:, 0].clone(), seen.orientations[:, 0].clone(), angles, seen.standing)


def minimise(now: RobotMotion, seen: Observations, held: int, *, iterations: int | None = None) -> RobotMotion:
    """Minimise the cost over all frames but the first, which are held; of a search from near, few iterations do."""
    damping, system = 1e-3, _System.of(now, seen)
    for _ in range(iterations or _ITERATIONS):
        while True:
            tried = system.step(now, damping, held)
            found = _System.of(tried, seen)
            if found.cost <= system.cost or damping > 1e3:
                break
            damping *= 10
        gained = system.cost - found.cost
        if gained < 0:
            break
        now, system, damping = tried, found, max(damping / 10, 1e-6)
        if gained < _CONVERGED * system.cost:
            break
    return now


_THIRD = (-1.0, 3.0, -3.0, 1.0)  # coefficients of the third difference


@dataclass(frozen=True, eq=False)
class _System:
    """The cost at a motion, and the linear system of its next step. Unknowns of a frame are the base's position,
    rotation about the world's axes, and angles."""

    cost: float
    hessian: Float[Tensor, "frames unknowns unknowns"]
    """Of each frame's own terms."""
    coupling: Float[Tensor, "steps joints"]
    """Weight of each joint's change from frame to frame."""
    gradient: Float[Tensor, "frames unknowns"]
    """Downhill."""
    jerk: Float[Tensor, " unknowns"]
    """Weight of squared third differences."""

    @staticmethod
    def of(now: RobotMotion, seen: Observations) -> "_System":
        """Linearise all terms at a motion."""
        robot, fps = now.robot, float(now.fps)
        at, world = robot.chain_links(now.orientation, now.angles)
        links, observed = [*seen.links, *robot.corner_links], len(seen.links)
        points = at[:, links] + (world[:, links] @ torch.cat([seen.points, *robot.soles])[..., None])[..., 0]
        missed = seen.positions - points[:, :observed] - now.position[:, None]
        away = seen.orientations @ world[:, seen.links].mT
        turned = rotations.to_rotation_vector(rotations.from_matrix(away))
        sunk = (-points[:, observed:, 2] - now.position[:, None, 2]).clamp_min(0)
        position_weights, orientation_weights = (
            weights[..., None].expand_as(missed).flatten(1)
            for weights in (seen.position_weights, seen.orientation_weights)
        )
        residual = torch.cat([missed.flatten(1), turned.flatten(1), sunk], dim=1)
        weights = torch.cat([position_weights, orientation_weights, (sunk > 0) / _SUNK_ERROR**2], dim=1)
        by_position, by_rotation = _differentiate(robot, links, points, at, world)
        jacobian = torch.cat(
            [
                by_position[:, :observed].flatten(1, 2),
                by_rotation[:, :observed].flatten(1, 2),
                by_position[:, observed:, 2],
            ],
            dim=1,
        )
        weighted = jacobian * weights[..., None]
        hessian, gradient = weighted.mT @ jacobian, (weighted.mT @ residual[..., None])[..., 0]
        cost = (weights * residual.square()).sum() + (now.angles / _ANGLE_ERROR).square().sum()
        joints = range(6, gradient.shape[1])
        hessian[:, joints, joints] += _ANGLE_ERROR**-2
        gradient[:, 6:] -= now.angles / _ANGLE_ERROR**2
        jerk = torch.tensor([_JERKS[0]] * 3 + [_JERKS[1]] * 3 + [_JERKS[2]] * len(joints), dtype=torch.float64)
        jerk = (fps**3 / jerk) ** 2
        spin = rotations.to_rotation_vector(rotations.from_matrix(now.orientation[1:] @ now.orientation[:-1].mT))
        third = [now.position.diff(n=3, dim=0), spin.diff(n=2, dim=0), now.angles.diff(n=3, dim=0)]
        if len(third[0]):
            rough = jerk * torch.cat(third, dim=1)
            cost = cost + (rough.square() / jerk).sum()
            for lag, sign in enumerate(_THIRD):
                gradient[lag : lag + len(rough)] -= sign * rough
        steps, most = now.angles.diff(dim=0), _SPEED_SHARE * robot.speed / fps
        beyond = steps - torch.minimum(torch.maximum(steps, -most), most)
        coupling = (beyond != 0) / _SPEED_ERROR**2
        cost = cost + (beyond / _SPEED_ERROR).square().sum()
        gradient[1:, 6:] -= coupling * beyond
        gradient[:-1, 6:] += coupling * beyond
        return _System(float(cost), hessian, coupling.double(), gradient, jerk)

    def step(self, now: RobotMotion, damping: float, held: int) -> RobotMotion:
        """Solve for the next motion."""
        robot, (frames, size) = now.robot, self.gradient.shape
        free = torch.ones(frames, size, dtype=torch.bool)
        leads = self.gradient[:, 6:]
        free[:, 6:] = ((now.angles > robot.low) | (leads > 0)) & ((now.angles < robot.high) | (leads < 0))
        free[:held] = False
        own = self.hessian * free[:, :, None] * free[:, None]
        diagonal = own.diagonal(dim1=1, dim2=2)
        own = own + torch.diag_embed(torch.where(free, damping * diagonal + 1e-9, 1.0))
        bands = np.zeros((3 * size + 1, frames * size))  # the upper ones, as scipy's solveh_banded has them
        for offset in range(size):
            bands[-1 - offset].reshape(frames, size)[:, offset:] = own.diagonal(offset=offset, dim1=1, dim2=2)
        for lag in range(4):  # of third differences
            row = np.zeros((frames, size))
            for later in range(lag, 4):
                row[later : later + max(0, frames - 3)] += _THIRD[later - lag] * _THIRD[later] * self.jerk.numpy()
            if lag == 0:
                row[1:, 6:] += self.coupling.numpy()
                row[:-1, 6:] += self.coupling.numpy()
            elif lag == 1:
                row[1:, 6:] -= self.coupling.numpy()
            row[lag:] *= (free[lag:] & free[: frames - lag]).numpy()
            bands[-1 - lag * size] += row.ravel()
        right = (self.gradient * free).numpy().ravel()
        change = torch.from_numpy(solveh_banded(bands, right).reshape(frames, size))
        wanted = now.angles + change[:, 6:]
        crossed = torch.zeros_like(free)
        crossed[:, 6:] = (wanted < robot.low) | (wanted > robot.high)
        if bool(crossed.any()):  # they end at their limits, and all others are solved for again
            stiff = _STIFF * crossed.double().numpy()
            to_limit = torch.zeros_like(change)
            to_limit[:, 6:] = wanted.clamp(robot.low, robot.high) - now.angles
            bands[-1] += stiff.ravel()
            right += (stiff * to_limit.numpy()).ravel()
            change = torch.from_numpy(solveh_banded(bands, right).reshape(frames, size))
        change = change / (change.abs().amax(dim=1, keepdim=True) / _LONGEST_STEP).clamp_min(1.0)
        return replace(
            now,
            position=now.position + change[:, :3],
            orientation=rotations.rotation_vector_to_matrix(change[:, 3:6]) @ now.orientation,
            angles=(now.angles + change[:, 6:]).clamp(robot.low, robot.high),
        )


def _differentiate(
    robot: Robot,
    links: list[int],
    points: Float[Tensor, "frames observed 3"],
    at: Float[Tensor, "frames links 3"],
    world: Float[Tensor, "frames links 3 3"],
) -> tuple[Float[Tensor, "frames observed 3 unknowns"], Float[Tensor, "frames observed 3 unknowns"]]:
    """Differentiate points on links, about the base, and the links' orientations by the unknowns."""
    hinges = list(robot.hinges)
    moved = robot.above[links][..., None].double()
    axes = (world[:, hinges] @ robot.axes[..., None])[:, None, ..., 0] * moved
    one = torch.eye(3, dtype=torch.float64).expand(*points.shape, 3)
    levers = torch.linalg.cross(one, points[..., None, :].expand_as(one))
    swung = torch.linalg.cross(axes, points[:, :, None] - at[:, None, hinges])
    by_position = torch.cat([one, levers, swung], dim=2)
    by_rotation = torch.cat([torch.zeros_like(one), one, axes], dim=2)
    return by_position.mT, by_rotation.mT


def _cut_speeds(found: RobotMotion) -> RobotMotion:
    """Cut what is left of speeds beyond the joints'."""
    most = found.robot.speed / float(found.fps)
    if not (found.angles.diff(dim=0).abs() > most).any():
        return found
    angles = [found.angles[0]]
    for wanted in found.angles[1:]:
        angles.append(torch.minimum(torch.maximum(wanted, angles[-1] - most), angles[-1] + most))
    return replace(found, angles=torch.stack(angles))
