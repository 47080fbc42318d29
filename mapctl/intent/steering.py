"""Steering: commands over time, and the targets that follow them at a limited rate (Wang et al. 2019, section 5.3).

Steering scripts: CSV files of time_s, speed_mps, heading_deg and, optionally, facing_deg, turn_deg_s, step_m, gait,
style, and places in the world as three columns each: left_hand_x, left_hand_y, left_hand_z, right_hand_x, ..., look_z;
and where to be before the rest of a line holds: goto_x_m, goto_z_m, goto_facing_deg, within_s and pose (FILE:FRAME).

A line that leaves an optional column empty faces where it goes, goes straight, has a free step length, gives the prior
no label, and reaches for nothing and looks at nothing in particular.
"""

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from os import PathLike
from pathlib import Path

from mapctl import formats
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
        for name in ("acceleration", "braking", "turn_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise RequestError(f"{name} must be positive, got {getattr(self, name):g}")


REACHING_HANDS = ("leftHand", "rightHand")
"""Joints that live targets may be given for."""
STEP_LENGTHS = (0.3, 1.2)
"""Shortest and longest step that can be asked for, metres. Beyond them feet slide to meet the target and speed is lost:
at 1.2 m/s, planted toes move 1 to 4 cm/s within, 9 for steps of 2.5 m, and for 99 m the whole body slides at 9 m/s."""


@dataclass(frozen=True, eq=False)
class Arrival:
    """An order to be somewhere at a time."""

    place: tuple[float, float]
    """Where the hips are to be over the ground, x and z, metres."""
    by: float
    """When, seconds of the stream."""
    facing: float | None = None
    """Facing of the hips there, radians; None faces where it came from another place, or as it did."""
    pose: Motion | None = None
    """Pose there, a canonical motion of one frame; None walks on, or stands where the command's speed is 0."""

    def __post_init__(self):
        if not all(map(math.isfinite, (*self.place, self.by, self.facing or 0.0))):
            raise RequestError("the place, the time and the facing of an arrival are finite numbers")


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
    """Rate at which the direction of travel turns on and on, radians/s, to the left where positive; `heading` then says
    nothing but where to begin."""
    step_length: float | None = None
    """Step length from one foot's touch-down to the other's, metres; None leaves it to the prior."""
    labels: tuple[str, ...] = ()
    """Labels of the prior that hold (a gait, a style: `run`, `elderly`); none leaves the motion to the other targets.
    """
    reach: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Places in the world that hands are to reach while they come past, metres, by REACHING_HANDS."""
    look_at: tuple[float, float, float] | None = None
    """Place in the world that is to be looked at, metres."""
    obstacles: tuple[Obstacle, ...] = ()
    """Discs and boxes on the ground to walk round."""
    arrival: Arrival | None = None
    """Where to be first, and when; the rest of the command holds from then on."""

    def __post_init__(self):
        if not (math.isfinite(self.speed) and self.speed >= 0):
            raise RequestError(f"a command's speed must be a number of m/s, 0 or more, got {self.speed:g}")
        if self.step_length is not None and not 0 < self.step_length < math.inf:
            raise RequestError(f"a command's step length must be positive, got {self.step_length:g} m")
        for name in ("heading", "facing", "turning"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise RequestError(f"a command's {name} must be a finite angle, got {value:g}")
        for name, place in {**self.reach, **({} if self.look_at is None else {"look_at": self.look_at})}.items():
            if name not in (*REACHING_HANDS, "look_at"):
                raise RequestError(f"a command reaches with {' or '.join(REACHING_HANDS)}, not with {name}")
            if len(place) != 3 or not all(map(math.isfinite, place)):
                raise RequestError(f"the place for {name} must be three finite numbers of metres, got {place}")

    def within(self, fastest: float, *, when: str = "") -> tuple["Command", list[str]]:
        """Limit the command to what can be held: at most `fastest` m/s, steps of STEP_LENGTHS, and angles of one turn.

        With a sentence for each number that changed; `when` (` at 3 s`) follows its name. An angle of more than a turn
        is the same direction, so nothing is said of it.
        """
        said, (shortest, longest) = [], STEP_LENGTHS
        speed, step = min(self.speed, fastest), self.step_length
        if speed < self.speed:
            said.append(f"the speed of {self.speed:g} m/s{when} was lowered to {speed:.2f} m/s, the prior's fastest")
        if step is not None and (held := min(longest, max(shortest, step))) != step:
            way = "raised" if held > step else "lowered"
            said.append(
                f"the step length of {step:g} m{when} was {way} to {held:g} m; "
                f"steps can be {shortest:g} to {longest:g} m long"
            )
            step = held
        turned = {name: _wrap_whole_turns(getattr(self, name)) for name in ("heading", "facing")}
        return replace(self, speed=speed, step_length=step, **turned), said


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

    def arrivals(self, before: float, upto: float) -> list[float]:
        """Return the times, seconds, at which a command came: later than `before`, and not later than `upto`,
        seconds."""
        return list(self.times[bisect_right(self.times, before + 1e-9) : bisect_right(self.times, upto + 1e-9)])

    def limit_speed(self, fastest: float) -> tuple["CommandTrack", list[str]]:
        """Limit every command to what can be held, speeds to the `fastest` (m/s); also return a note for each number
        that was changed."""
        found = [
            command.within(fastest, when=f" at {time:g} s")
            for time, command in zip(self.times, self.commands, strict=True)
        ]
        return CommandTrack(self.times, tuple(command for command, _ in found)), [
            one for _, said in found for one in said
        ]


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
        wishes, wish = [], self
        for _ in range(frames):
            wish = wish.step_toward(command, limits, 1 / fps)
            wishes.append(wish)
        return wishes


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
_PLACES = (*_HAND_COLUMNS, "look")
_GOTO, _GOTO_MORE = ("goto_x_m", "goto_z_m", "within_s"), ("goto_facing_deg", "pose")
_ALLOWED_COLUMNS = (
    *_REQUIRED_COLUMNS,
    "facing_deg",
    "turn_deg_s",
    "step_m",
    *_LABEL_COLUMNS,
    *(f"{name}_{axis}" for name in _PLACES for axis in "xyz"),
    *_GOTO,
    *_GOTO_MORE,
)
_MAX_SPEED, _MAX_TIME, _MAX_VALUE, _MAX_PLACE = 1000.0, 1e6, 1e6, 1e4
_MAX_GOTO, _MAX_WITHIN = 1000.0, 3600.0


def read_commands(path: str | PathLike[str]) -> CommandTrack:
    """Read the commands of a file. FileFormatError names file and line, and what was expected there."""
    lines = read_table(path, f"a CSV of the columns {','.join(_REQUIRED_COLUMNS)}")
    header, names = (lines[0][0], [word.lower() for word in lines[0][1]]) if lines else (1, [])
    missing = [name for name in _REQUIRED_COLUMNS if name not in names]
    if missing:
        raise FileFormatError(
            path, f"has no column {', '.join(missing)}; expected {','.join(_REQUIRED_COLUMNS)}", header
        )
    unknown = [name for name in names if name not in _ALLOWED_COLUMNS]
    if unknown or len(set(names)) < len(names):
        found = shorten(",".join(names))
        raise FileFormatError(
            path, f"found the columns {found}, expected {','.join(_ALLOWED_COLUMNS)}, each once", header
        )
    if len(lines) < 2:
        raise FileFormatError(path, "holds no commands")
    times: list[float] = []
    commands: list[Command] = []
    for number, words in lines[1:]:
        if len(words) != len(names):
            raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", number)
        line = _Line(path, number, dict(zip(names, words, strict=True)))
        time = line.within("time_s", 0, _MAX_TIME)
        if times and time <= times[-1]:
            raise FileFormatError(path, f"time_s must rise, got {time:g} after {times[-1]:g}", number)
        times.append(time)
        commands.append(line.command())
    return CommandTrack(tuple(times), tuple(commands))


@dataclass(frozen=True)
class _Line:
    """One line of a script."""

    path: str | PathLike[str]
    number: int
    words: dict[str, str]

    def command(self) -> Command:
        labels = tuple(self.words[name] for name in _LABEL_COLUMNS if self.words.get(name))
        speed = self.within("speed_mps", 0, _MAX_SPEED)
        return Command(
            speed,
            math.radians(self.value("heading_deg")),
            self.angle("facing_deg"),
            self.angle("turn_deg_s"),
            self.within("step_m", 0.05, 3.0) if self.words.get("step_m") else None,
            labels,
            {joint: place for name, joint in _HAND_COLUMNS.items() if (place := self.place(name)) is not None},
            self.place("look"),
            arrival=self.arrival(),
        )

    def arrival(self) -> Arrival | None:
        """Return where to be, and by when; None where the line says nothing of it."""
        told = [name for name in (*_GOTO, *_GOTO_MORE) if self.words.get(name)]
        if not told:
            return None
        if missing := [name for name in _GOTO if name not in told]:
            raise FileFormatError(self.path, f"{told[0]} needs {' and '.join(missing)} too", self.number)
        x, z = (self.within(name, -_MAX_GOTO, _MAX_GOTO) for name in ("goto_x_m", "goto_z_m"))
        within = self.within("within_s", 0, _MAX_WITHIN)
        if within == 0:
            raise FileFormatError(self.path, "within_s must be more than 0", self.number)
        by = self.value("time_s") + within
        return Arrival((x, z), by, self.angle("goto_facing_deg"), self.pose() if "pose" in told else None)

    def pose(self) -> Motion:
        """Return the pose of FILE:FRAME, canonical."""
        name, colon, number = self.words["pose"].rpartition(":")
        if not (name and colon and number.isdecimal()):
            raise FileFormatError(
                self.path, f"pose is FILE:FRAME, a motion file and a frame of it; got {self.words['pose']}", self.number
            )
        file = Path(self.path).parent / name
        try:
            motion = formats.load(file)
            pose = (
                to_canonical(motion.slice(int(number), int(number) + 1))[0] if int(number) < motion.num_frames else None
            )
        except (OSError, MapctlError) as error:
            raise FileFormatError(self.path, f"pose: {error}", self.number) from error
        if pose is None:
            raise FileFormatError(
                self.path, f"pose: {name} has the frames 0:{motion.num_frames}, and no {number}", self.number
            )
        return pose

    def place(self, name: str) -> tuple[float, float, float] | None:
        """Return a place of three columns, metres; None where the line leaves all of them open."""
        columns = [f"{name}_{axis}" for axis in "xyz"]
        told = [column for column in columns if self.words.get(column)]
        if not told:
            return None
        if len(told) < len(columns):
            raise FileFormatError(self.path, f"{name} needs {', '.join(columns)}, all or none", self.number)
        x, y, z = (self.within(column, -_MAX_PLACE, _MAX_PLACE) for column in columns)
        return x, y, z

    def angle(self, name: str) -> float | None:
        """Return an angle in radians; None where the line leaves it open."""
        return math.radians(self.value(name)) if self.words.get(name) else None

    def within(self, name: str, low: float, high: float) -> float:
        if not low <= (value := self.value(name)) <= high:
            raise FileFormatError(
                self.path, f"{name} must lie between {low:g} and {high:g}, got {value:g}", self.number
            )
        return value

    def value(self, name: str) -> float:
        value = finite_number(self.words[name])
        if value is None or abs(value) > _MAX_VALUE:
            raise FileFormatError(self.path, f"{name} must be a number, got {shorten(self.words[name])}", self.number)
        return value
