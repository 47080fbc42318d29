"""Steering: commands over time, and the targets that follow them at a limited rate (Wang et al. 2019, section 5.3).

Steering scripts: CSV files of time_s, speed_mps, heading_deg and, optionally, facing_deg, turn_deg_s, step_m, gait,
style, and positions in the world as three columns each: left_hand_x, left_hand_y, left_hand_z, right_hand_x, ...,
look_z; and where to be before the rest of a line holds: goto_x_m, goto_z_m, goto_facing_deg, within_s and pose
(FILE:FRAME).

A line that leaves an optional column empty faces where it goes, goes straight, has a free step length, gives the prior
no label, and reaches for nothing and looks at nothing in particular.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate, pairwise
from os import PathLike
from pathlib import Path

from mapctl import formats
from mapctl.arguments import read_names, read_number, read_point
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.formats.text import finite_number, read_table, shorten
from mapctl.motion import Motion
from mapctl.retarget import to_canonical


@dataclass(frozen=True)
class SteeringLimits:
    """Limits on the rate of change of the target; a jump in the command becomes the fastest change that these allow."""

    acceleration: float = 2.0
    """Largest rise of the speed, m/s^2."""
    braking: float = 2.0
    """Largest fall of the speed, m/s^2."""
    turn_rate: float = 2.5
    """Largest turn rate of the direction, radians/s. More than the one-second means of a walk's data show
    (`DataLimits.turn_rate`): a reversal has to be faster."""

    def __post_init__(self):
        names = ("acceleration", "braking", "turn_rate")
        _read_numbers(self, names)
        for name in names:
            if getattr(self, name) <= 0:
                raise RequestError(f"{name} must be positive, got {getattr(self, name):g}")


REACHING_HANDS = ("leftHand", "rightHand")
"""Joints that live targets may be given for."""
STEP_LENGTHS = (0.3, 1.2)
"""Shortest and longest step that can be requested, metres. Beyond them feet slide to meet the target and speed is lost:
at 1.2 m/s, planted toes move 1 to 4 cm/s within, 9 for steps of 2.5 m, and for 99 m the whole body slides at 9 m/s."""


@dataclass(frozen=True, eq=False)
class Arrival:
    """An order to be somewhere at a time; equal to another with the same values, so that it may be built anew at every
    step."""

    position: tuple[float, float]
    """Where the hips are to be over the ground, x and z, metres."""
    by: float
    """When, seconds of the stream."""
    facing: float | None = None
    """Facing of the hips there, radians; None faces where it came from another position, or as it did."""
    pose: Motion | None = None
    """Pose there, a canonical motion of one frame; None walks on, or stands where the command's speed is 0."""

    def __post_init__(self):
        object.__setattr__(self, "position", read_point(self.position, 2, "the position of an arrival"))
        _read_numbers(self, ("by",), optional=("facing",))
        if self.pose is not None and not isinstance(self.pose, Motion):
            raise RequestError(f"the pose of an arrival must be a Motion, got {type(self.pose).__name__}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Arrival) and self._values == other._values

    def __hash__(self) -> int:
        return hash((self.position, self.by, self.facing))

    @property
    def _values(self) -> tuple[object, ...]:
        pose = self.pose and (self.pose.root_position.tolist(), self.pose.local_quat_xyzw.tolist())
        return self.position, self.by, self.facing, pose


@dataclass(frozen=True)
class Command:
    """One steering command, held until the next one."""

    speed: float
    """Speed over the ground, m/s; 0 is to stand."""
    heading: float
    """Direction of travel, radians about +Y: 0 is +Z, pi/2 is +X. Where the speed is 0, where to face."""
    facing: float | None = None
    """Facing of the hips, radians; None is the direction of travel."""
    turning: float | None = None
    """Rate at which the direction of travel turns on and on, radians/s, to the left where positive; `heading` is then
    where to begin."""
    step_length: float | None = None
    """Step length from one foot's touch-down to the other's, metres; None leaves it to the prior."""
    labels: tuple[str, ...] = ()
    """Labels of the prior that hold (a gait, a style: `run`, `elderly`); none leaves the motion to the other targets.
    """
    reach: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Positions in the world that hands are to reach while they come past, metres, by REACHING_HANDS."""
    look_at: tuple[float, float, float] | None = None
    """Position in the world that is to be looked at, metres."""
    obstacles: tuple[Obstacle, ...] = ()
    """Discs and boxes on the ground to walk round."""
    arrival: Arrival | None = None
    """Where to be first, and when; the rest of the command holds from then on."""

    def __post_init__(self):
        _read_numbers(self, ("speed", "heading"), optional=("facing", "turning", "step_length"))
        if self.speed < 0:
            raise RequestError(f"a command's speed must be 0 m/s or more, got {self.speed:g}")
        if self.step_length is not None and self.step_length <= 0:
            raise RequestError(f"a command's step length must be positive, got {self.step_length:g} m")
        if not isinstance(self.reach, Mapping) or not {*self.reach} <= {*REACHING_HANDS}:
            wrong = ", ".join(map(str, self.reach)) if isinstance(self.reach, Mapping) else self.reach
            raise RequestError(f"a command reaches with {' or '.join(REACHING_HANDS)}, not with {wrong}")
        keep = partial(object.__setattr__, self)
        keep("reach", {name: read_point(point, 3, f"the position for {name}") for name, point in self.reach.items()})
        if self.look_at is not None:
            keep("look_at", read_point(self.look_at, 3, "the position for look_at"))
        keep("labels", read_names(self.labels, "a command's labels"))
        keep("obstacles", tuple(self.obstacles) if isinstance(self.obstacles, Iterable) else (None,))
        if not all(isinstance(each, Obstacle) for each in self.obstacles):
            raise RequestError("a command's obstacles must be a sequence of Obstacle")
        if not isinstance(self.arrival, Arrival | None):
            raise RequestError("a command's arrival must be an Arrival")

    @property
    def hips_heading(self) -> float:
        """Facing of the hips, radians: the given one, else the direction of travel."""
        return self.heading if self.facing is None else self.facing

    def within(self, fastest: float, *, when: str = "") -> tuple["Command", list[str]]:
        """Limit the command to what can be held: at most `fastest` m/s, steps of STEP_LENGTHS, and angles of one turn.

        With a sentence for each number that changed; `when` (` at 3 s`) follows its name. An angle of more than a turn
        is the same direction, without a note.
        """
        notes, (shortest, longest) = [], STEP_LENGTHS
        speed, step = min(self.speed, fastest), self.step_length
        if speed < self.speed:
            notes.append(f"the speed of {self.speed:g} m/s{when} was lowered to {speed:.2f} m/s, the prior's fastest")
        if step is not None and (held := min(longest, max(shortest, step))) != step:
            change = f"{'raised' if held > step else 'lowered'} to {held:g} m"
            allowed = f"steps can be {shortest:g} to {longest:g} m long"
            notes.append(f"the step length of {step:g} m{when} was {change}; {allowed}")
            step = held
        turned = {name: _wrap_whole_turns(getattr(self, name)) for name in ("heading", "facing")}
        return replace(self, speed=speed, step_length=step, **turned), notes


@dataclass(frozen=True)
class CommandTrack:
    """Commands at rising times; before the first time the first command holds."""

    times: tuple[float, ...]
    """Times, seconds."""
    commands: tuple[Command, ...]
    """Commands from those times on."""

    def __post_init__(self):
        if not self.times or len(self.times) != len(self.commands):
            raise RequestError("a track needs a time for each of its commands, and at least one")
        for before, after in pairwise(self.times):
            if not before < after:
                raise RequestError(f"the times of commands must rise, got {after:g} s after {before:g} s")

    def at(self, seconds: float) -> Command:
        """Return the command that holds at a time."""
        return self.commands[max(0, bisect_right(self.times, seconds + 1e-9) - 1)]

    def limit_speed(self, fastest: float) -> tuple["CommandTrack", list[str]]:
        """Limit every command to what can be held, speeds to the `fastest` (m/s); also return a note for each number
        that was changed."""
        pairs = zip(self.times, self.commands, strict=True)
        found = [command.within(fastest, when=f" at {time:g} s") for time, command in pairs]
        notes = [note for _, notes in found for note in notes]
        return CommandTrack(self.times, tuple(command for command, _ in found)), notes


@dataclass(frozen=True)
class SteeringTarget:
    """Target of one frame: a command that has come as far as the limits allow."""

    speed: float
    """Speed, m/s."""
    heading: float
    """Direction of travel, radians, not wrapped."""
    facing: float
    """Facing, radians, not wrapped."""

    @property
    def velocity(self) -> tuple[float, float]:
        """Target velocity over the ground, x and z, m/s."""
        return self.speed * math.sin(self.heading), self.speed * math.cos(self.heading)

    def step_toward(self, command: Command, limits: SteeringLimits, seconds: float) -> "SteeringTarget":
        """Step the target toward the command for so many seconds, as far as the limits allow."""
        rise = min(limits.acceleration * seconds, max(-limits.braking * seconds, command.speed - self.speed))
        most = limits.turn_rate * seconds
        if command.turning is None:
            turn = _step_angle_toward(self.heading, command.heading, most)
        else:
            turn = self.heading + min(most, max(-most, command.turning * seconds))
        facing = turn if command.facing is None else command.facing
        return SteeringTarget(self.speed + rise, turn, _step_angle_toward(self.facing, facing, most))

    def ahead(self, command: Command, limits: SteeringLimits, *, frames: int, fps: float) -> "list[SteeringTarget]":
        """Return the targets of the next frames if the command stays."""
        steps = accumulate(range(frames), lambda target, _: target.step_toward(command, limits, 1 / fps), initial=self)
        return list(steps)[1:]


def _read_numbers(holder: object, names: Sequence[str], *, optional: Sequence[str] = ()) -> None:
    """Turn these attributes into finite floats, the optional ones where they are not None."""
    for name in (*names, *optional):
        if (value := getattr(holder, name)) is not None or name in names:
            object.__setattr__(holder, name, read_number(value, name))


def _wrap_whole_turns(angle: float | None) -> float | None:
    """Remove whole turns from an angle; other angles stay to the bit."""
    return angle if angle is None or abs(angle) <= 2 * math.pi else math.remainder(angle, 2 * math.pi)


def _step_angle_toward(angle: float, wanted: float, most: float) -> float:
    """Step an angle toward another by at most so much, the short way."""
    apart = math.remainder(wanted - angle, 2 * math.pi)
    return angle + min(most, max(-most, apart))


_REQUIRED_COLUMNS = ("time_s", "speed_mps", "heading_deg")
_LABEL_COLUMNS = ("gait", "style")
_HAND_COLUMNS = dict(zip(("left_hand", "right_hand"), REACHING_HANDS, strict=True))
_GOTO = ("goto_x_m", "goto_z_m", "within_s")
_ALLOWED_COLUMNS = (
    *_REQUIRED_COLUMNS,
    *("facing_deg", "turn_deg_s", "step_m", *_LABEL_COLUMNS),
    *(f"{name}_{axis}" for name in (*_HAND_COLUMNS, "look") for axis in "xyz"),
    *(*_GOTO, "goto_facing_deg", "pose"),
)
_MAX_VALUE = 1e6


def read_commands(path: str | PathLike[str]) -> CommandTrack:
    """Read the commands of a file. FileFormatError names file and line, and what was expected there."""
    lines = read_table(path, f"a CSV of the columns {','.join(_REQUIRED_COLUMNS)}")
    header, names = (lines[0][0], [word.lower() for word in lines[0][1]]) if lines else (1, [])
    missing = [name for name in _REQUIRED_COLUMNS if name not in names]
    if missing:
        expected = ",".join(_REQUIRED_COLUMNS)
        raise FileFormatError(path, f"has no column {', '.join(missing)}; expected {expected}", header)
    if not set(names) <= set(_ALLOWED_COLUMNS) or len(set(names)) < len(names):
        found, allowed = shorten(",".join(names)), ",".join(_ALLOWED_COLUMNS)
        raise FileFormatError(path, f"found the columns {found}, expected {allowed}, each once", header)
    if len(lines) < 2:
        raise FileFormatError(path, "holds no commands")
    times, commands = list[float](), list[Command]()
    for number, words in lines[1:]:
        if len(words) != len(names):
            raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", number)
        line = _Line(path, number, {name: word for name, word in zip(names, words, strict=True) if word})
        time = line.number_in("time_s", 0, _MAX_VALUE)
        if times and time <= times[-1]:
            raise FileFormatError(path, f"time_s must rise, got {time:g} after {times[-1]:g}", number)
        times.append(time)
        commands.append(line.command(time))
    return CommandTrack(tuple(times), tuple(commands))


@dataclass(frozen=True)
class _Line:
    """The values that a line of a script gives, by column."""

    path: str | PathLike[str]
    number: int
    words: dict[str, str]

    def command(self, time: float) -> Command:
        reach = {joint: self.point(name) for name, joint in _HAND_COLUMNS.items()}
        return Command(
            self.number_in("speed_mps", 0, 1000),
            math.radians(self.number_in("heading_deg")),
            self.angle("facing_deg"),
            self.angle("turn_deg_s"),
            self.number_in("step_m", 0.05, 3.0) if "step_m" in self.words else None,
            tuple(self.words[name] for name in _LABEL_COLUMNS if name in self.words),
            {joint: point for joint, point in reach.items() if point is not None},
            self.point("look"),
            arrival=self.arrival(time),
        )

    def arrival(self, time: float) -> Arrival | None:
        """Return the target of the hips and its time; None where the line has none."""
        given = [name for name in (*_GOTO, "goto_facing_deg", "pose") if name in self.words]
        if not given:
            return None
        if missing := [name for name in _GOTO if name not in given]:
            raise self.fault(f"{given[0]} needs {' and '.join(missing)} too")
        x, z = (self.number_in(name, -1000, 1000) for name in ("goto_x_m", "goto_z_m"))
        within = self.number_in("within_s", 0, 3600)
        if within == 0:
            raise self.fault("within_s must be more than 0")
        return Arrival((x, z), time + within, self.angle("goto_facing_deg"), self.pose() if "pose" in given else None)

    def pose(self) -> Motion:
        """Return the pose of FILE:FRAME, canonical."""
        name, _, frame = self.words["pose"].rpartition(":")
        if not (name and frame.isdecimal()):
            raise self.fault(f"pose is FILE:FRAME, a motion file and a frame of it; got {self.words['pose']}")
        try:
            motion, at = formats.load(Path(self.path).parent / name), int(frame)
            if at >= motion.num_frames:
                raise RequestError(f"{name} has the frames 0:{motion.num_frames}, and no {frame}")
            return to_canonical(motion.slice(at, at + 1))[0]
        except (OSError, MapctlError) as error:
            raise self.fault(f"pose: {error}") from error

    def point(self, name: str) -> tuple[float, float, float] | None:
        """Return a point of three columns, metres; None where the line gives none of them."""
        columns = [f"{name}_{axis}" for axis in "xyz"]
        given = [column for column in columns if column in self.words]
        if not given:
            return None
        if len(given) < len(columns):
            raise self.fault(f"{name} needs {', '.join(columns)}, all or none")
        x, y, z = (self.number_in(column, -1e4, 1e4) for column in columns)
        return x, y, z

    def angle(self, name: str) -> float | None:
        """Return an angle in radians; None where the line does not give it."""
        return math.radians(self.number_in(name)) if name in self.words else None

    def number_in(self, name: str, low: float = -_MAX_VALUE, high: float = _MAX_VALUE) -> float:
        word = self.words.get(name, "")
        value = finite_number(word)
        if value is None or abs(value) > _MAX_VALUE:
            raise self.fault(f"{name} must be a number, got {shorten(word)}")
        if not low <= value <= high:
            raise self.fault(f"{name} must lie between {low:g} and {high:g}, got {value:g}")
        return value

    def fault(self, reason: str) -> FileFormatError:
        return FileFormatError(self.path, reason, self.number)
