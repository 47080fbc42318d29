"""Steering scripts: CSV files of time_s, speed_mps, heading_deg and, optionally, facing_deg, turn_deg_s, step_m, gait,
style, and places in the world as three columns each: left_hand_x, left_hand_y, left_hand_z, right_hand_x, ..., look_z;
and where to be before the rest of a line holds: goto_x_m, goto_z_m, goto_facing_deg, within_s and pose (FILE:FRAME).

A line that leaves an optional column empty faces where it goes, goes straight, has a free step length, gives the prior
no label, and reaches for nothing and looks at nothing in particular.
"""

import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from mapctl import formats
from mapctl.errors import FileFormatError, MapctlError
from mapctl.formats.text import finite_number, read_table, shorten
from mapctl.intent.steering import REACHING_HANDS, Arrival, Command, CommandTrack
from mapctl.motion import Motion
from mapctl.retarget import to_canonical

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
