"""Options that several commands share: their types for tyro, and checks that need nothing heavy."""

import re
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from mapctl.errors import RequestError

OutFile = Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
OutFolder = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
DataFolder = Annotated[Path, arg(metavar="DIR")]
MaybeDataFolder = Annotated[Path | None, arg(metavar="DIR")]
File = Annotated[Path, arg(metavar="FILE")]
InFile = Positional[Annotated[Path, arg(metavar="IN")]]
CurveText = Annotated[str, arg(metavar="CURVE")]
Speed = Annotated[str, arg(metavar="M/S|ARC:M/S,...")]
Number = Annotated[float, arg(metavar="NUMBER")]
Count = Annotated[int, arg(metavar="N")]
Name = Annotated[str, arg(metavar="NAME")]
MaybeSpeed = Annotated[str | None, arg(metavar="M/S|ARC:M/S,...")]
MaybeFile = Annotated[Path | None, arg(metavar="FILE")]
MaybeCurve = Annotated[str | None, arg(metavar="CURVE")]
MaybeNumber = Annotated[float | None, arg(metavar="NUMBER")]
MaybeCount = Annotated[int | None, arg(metavar="N")]
MaybeName = Annotated[str | None, arg(metavar="NAME")]
MaybeDna = Annotated[str | None, arg(metavar="CLIP|NAME,...")]
MaybeRig = Annotated[str | None, arg(metavar="PRESET|FILE.toml|CLIP")]
MaybeEndpoint = Annotated[str | None, arg(metavar="HOST:PORT")]
MaybeSize = Annotated[str | None, arg(metavar="WxH")]
MaybeCharacter = Annotated[str | None, arg(metavar="CHARACTER")]
MaybeWeights = Annotated[str | None, arg(metavar="free|full")]
CameraKind = Literal["follow", "fixed", "top"]
Size = Annotated[str, arg(metavar="WxH")]

Method = Annotated[str, arg(metavar="auto|transformer|infiller|tweener|stitcher|rollouts|slerp")]
OutRig = Annotated[str, arg(metavar="canonical|PRESET|FILE.toml|CLIP")]
MaybeAxis = Annotated[Literal["x", "y", "z", "-x", "-y", "-z"] | None, arg(metavar="x|y|z|-x|-y|-z")]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options on how motion files are read, which overrule what would be found."""

    unit: Annotated[str | None, arg(metavar="m|dm|cm|mm|in|METRES")] = None
    """Unit of lengths in the file that is read, or its length in metres; if not given, the one that the file declares
    or, in a .bvh or .amc, in which the body is nearest to an adult."""
    up: MaybeAxis = None
    """Axis of the motion that is read which points up; found by the body and its motion if not given."""


@dataclass(frozen=True, kw_only=True)
class RigOptions(ReadOptions):
    """The same for commands that read motions of one rig."""

    rig: MaybeRig = None
    """The rig of what is read, where it is not the one that would be recognised; see `mapctl info IN`."""


def check_seed(seed: int) -> None:
    """Raise RequestError unless torch can take the seed."""
    if not 0 <= seed < 2**63:
        raise RequestError(f"the seed must be a whole number from 0 to 2^63 - 1, got {seed}")


def parse_size(text: str) -> tuple[int, int]:
    """Parse `1280x720` as width and height in pixels."""
    found = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if found is None:
        raise RequestError(f"the size is WIDTHxHEIGHT in pixels, as 1280x720, got {text!r}")
    return int(found[1]), int(found[2])


def describe_request(name: str, command: Any) -> dict[str, Any]:
    """Describe a command and its options as a report shows them; how files are read only where that is given."""
    values = {field.name: getattr(command, field.name) for field in fields(command)}
    unset = {field.name for field in fields(RigOptions) if values.get(field.name) is None}
    return {"command": name} | {key: _describe_value(value) for key, value in values.items() if key not in unset}


def _describe_value(value: Any) -> Any:
    """Describe a value in plain numbers, texts, lists and tables: paths and what tables of a file were read as."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple | list):
        return [_describe_value(each) for each in value]
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def collect_paths(*paths: Path | None) -> list[Path]:
    """Collect the paths that are given."""
    return [path for path in paths if path is not None]
