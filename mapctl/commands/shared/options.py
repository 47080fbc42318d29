"""Options that several commands share: their types for tyro, and checks that need nothing heavy."""

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from mapctl.errors import RequestError

OutFile = Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
OutFolder = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
InFile = Positional[Annotated[Path, arg(metavar="IN")]]
CurveText = Annotated[str, arg(metavar="CURVE")]
Number = Annotated[float, arg(metavar="NUMBER")]
Count = Annotated[int, arg(metavar="N")]
Name = Annotated[str, arg(metavar="NAME")]
Prior = Annotated[str, arg(metavar="NAME", help="A bundled prior, or the file or run folder of a trained one.")]
_LIVELINESS = "Variety of walks: 0 is the most probable one, smoother than people walk; 1 is as varied as the prior."
Liveliness = Annotated[float, arg(metavar="0..1", help=_LIVELINESS)]
Quiet = Annotated[bool, arg(help="No summary and no progress bar.")]
Avoid = Annotated[
    UseAppendAction[tuple[str, ...]],
    arg(metavar="X,Z,RADIUS", help="A disc on the ground to walk around, metres; may be given several times."),
]
MaybeSpeed = Annotated[str | None, arg(metavar="M/S|ARC:M/S,...")]
MaybeFile = Annotated[Path | None, arg(metavar="FILE")]
MaybeCurve = Annotated[str | None, arg(metavar="CURVE")]
MaybeNumber = Annotated[float | None, arg(metavar="NUMBER")]
MaybeName = Annotated[str | None, arg(metavar="NAME")]
_MARKERS = """For positions (.c3d, .trc, .csv, .npy) with names of no known marker set: a TOML that names the markers
whose mean is a joint's centre, as leftLowerLeg = ["LKNE", "LKNM"]."""
MaybeMarkers = Annotated[Path | None, arg(metavar="FILE.toml", help=_MARKERS)]
MaybeRig = Annotated[str | None, arg(metavar="PRESET|FILE.toml|CLIP")]
MaybeEndpoint = Annotated[str | None, arg(metavar="HOST:PORT")]
MaybeCharacter = Annotated[str | None, arg(metavar="CHARACTER")]
MaybeWeights = Annotated[str | None, arg(metavar="free|full")]
CameraKind = Literal["follow", "fixed", "top"]
Size = Annotated[str, arg(metavar="WxH")]

OutRig = Annotated[str, arg(metavar="canonical|PRESET|FILE.toml|CLIP")]
_BODY = """Body that moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by
name or TOML file, whose joints get the canonical bones."""
BodyRig = Annotated[str, arg(metavar="canonical|PRESET|FILE.toml|CLIP", help=_BODY)]
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


@dataclass(frozen=True, kw_only=True)
class FolderOptions:
    """Options for a folder in place of a file."""

    jobs: Count = 1
    """For a folder: number of files at once, each in a process of its own."""
    again: bool = False
    """For a folder: write files again whose result exists already."""
    quiet: Quiet = False


@dataclass(frozen=True, kw_only=True)
class ProposalOptions:
    """Options on how in-betweens are proposed."""

    method: Annotated[str, arg(metavar="auto|transformer|infiller|tweener|stitcher|rollouts|slerp")] = "auto"
    """Method that proposes. auto: the transformer, the tweener, if the set of weights has one, through gaps of more
    than 8 s and those of more than 6 s in which the transformer hardly moves, or a held pose where the body stands
    still; a note on each gap names it. transformer, infiller, tweener: that network alone. stitcher: gaps of up to 2 s
    between whole poses from both sides. rollouts: a density's rollouts, wherever nothing is known. slerp:
    interpolation."""
    dna: Annotated[str | None, arg(metavar="CLIP|NAME,...")] = None
    """Motion files of any known rig, or classes that `mapctl info tweener` lists, whose style the tweener takes: in all
    gaps with --method tweener, in those of 2 s and more between whole poses with auto. Several are mixed."""
    no_refine: bool = False
    """Leave the proposal as it is, on rigid bones and with exact keys: no MAP stage plants the feet."""
    inbetweener: MaybeName = None
    """The file or run folder of a trained transformer, infiller or tweener; the bundled one if not given. With auto a
    tweener is for long gaps, beside the bundled transformer."""
    stitcher: MaybeName = None
    """The file or run folder of a trained stitcher for --method stitcher, where --inbetweener fills what it leaves; the
    bundled one if not given."""
    path: MaybeName = None
    """The file or run folder of a trained path predictor, for the tweener trained with it and for `infill --way`; the
    bundled one if not given."""


def check_seed(seed: int) -> None:
    """Raise RequestError unless torch can take the seed."""
    if not 0 <= seed < 2**63:
        raise RequestError(f"the seed must be a whole number from 0 to 2^63 - 1, got {seed}")


def check_liveliness(liveliness: float) -> None:
    """Raise RequestError unless the liveliness is from 0 to 1."""
    if not 0 <= liveliness <= 1:
        raise RequestError(f"--liveliness must be 0 to 1, got {liveliness:g}")


def check_variations(count: int) -> None:
    """Raise RequestError for no variations, and for more than their three digits number."""
    if not 1 <= count <= 1000:
        raise RequestError(f"--variations must be 1 to 1000, got {count}")


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
    return [path for path in paths if path is not None]


_FRAME = re.compile(r"(\d{1,9})|(\d{1,9}(?:\.\d{0,9})?|\.\d{1,9})s")


def parse_frame(text: str, *, fps: float) -> int:
    """Parse `45` or `1.5s` as a frame of a motion of that rate; RequestError for anything else."""
    found = _FRAME.fullmatch(text.strip())
    if found is None:
        raise RequestError(f"a frame is a whole number from 0, or seconds as in 1.5s; got {text!r}")
    return int(found[1]) if found[1] is not None else round(float(found[2]) * fps)


def parse_range(text: str, *, fps: float, frames: int, what: str = "gap") -> tuple[int, int]:
    """Parse `60:120` or `2s:4s` as first frame and one past the last; RequestError unless they are in the motion."""
    start, colon, stop = text.partition(":")
    if not colon:
        raise RequestError(f"a {what} is A:B, frames or seconds as in 60:120 or 2s:4s; got {text!r}")
    first, last = parse_frame(start, fps=fps), parse_frame(stop, fps=fps)
    if not first < last <= frames:
        raise RequestError(f"the {what} {text} must begin before it ends, within the motion's frames 0:{frames}")
    return first, last


def parse_ranges(texts: Sequence[str], *, fps: float, frames: int, what: str = "gap") -> list[tuple[int, int]]:
    """Parse several ranges, sorted by time; RequestError for two that overlap."""
    ranges = sorted(parse_range(text, fps=fps, frames=frames, what=what) for text in texts)
    for (start, stop), (after, end) in pairwise(ranges):
        if after < stop:
            raise RequestError(f"the {what}s {start}:{stop} and {after}:{end} overlap; make them one")
    return ranges
