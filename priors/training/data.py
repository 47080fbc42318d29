"""A folder of motion files as training features: read once, cached, split by clip.

Clips of any performer on the canonical body, their feet on a level floor.

Features keep the hips' height and way of whoever was recorded, while priors are decoded on canonical bones. Of captures
whose floor slopes or whose feet rest at another height, as those of CMU, features would say that feet go through the
floor, and contacts be found where the floor is lowest alone.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.contacts import ContactSettings, estimate_floor_heights
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.formats import load
from mapctl.formats.text import finite_number, read_table
from mapctl.metrics.gait import PACES, PaceChanges, count_pace_changes, follow_pace, measure_speed
from mapctl.motion import Motion
from mapctl.retarget import RigMap, identify_rig, rigs
from mapctl.retarget.carry import RiggedCharacter, retarget_canonical
from mapctl.retarget.character import Stance
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.checkpoints import write_tensors

TABLE_NAME = "Frame_Cuts.csv"
"""Tables of this name are found in a data folder and below it; each holds for the files beside and below it."""
CMU = Path("cmu")
"""The name of the table for takes of the CMU database that comes with mapctl, in place of a file of one's own."""
_CMU_TABLE = Path(__file__).with_name("cmu_cuts.csv")
_EXPECTED = "a table of file, first, last, or of STYLE_NAME and a _START and a _STOP column for each kind of clip"
_STYLE = "style_name"
_COLUMNS = ("file", "first", "last")
_NONE = ("", "n/a", "na", "nan", "-")


@dataclass(frozen=True)
class Cut:
    """The frames of a file that are motion, as the file counts them, from 0 on."""

    first: int = 0
    """First of them."""
    stop: int | None = None
    """The one after the last of them; None where the file ends."""
    where: str = ""
    """Table and line, for messages."""

    def apply(self, motion: Motion) -> Motion:
        """Only these frames; MapctlError where the file has no such frames."""
        stop = motion.num_frames if self.stop is None else self.stop
        if stop > motion.num_frames or stop - self.first < 2:
            last = "the end" if self.stop is None else f"{stop - 1}"
            raise MapctlError(f"{self.where} takes frames {self.first} to {last}, but the file has {motion.num_frames}")
        return motion.slice(self.first, stop)


@dataclass(frozen=True)
class CutTable:
    """One table."""

    file: Path
    """Where it was read."""
    named: Mapping[str, Cut]
    """By the name of the file, without its ending; it may begin with folders."""
    patterns: tuple[tuple[str, Cut], ...] = ()
    """Names with *, ? or [...], in the table's order."""

    def find(self, name: str) -> Cut | None:
        """The cut of a file, told by its path below the folder that the table is for; None where it has none.

        A row that names the file counts before rows with patterns; of those the first that fits. What a row names is
        the path or the end of it.
        """
        path = PurePosixPath(_strip_ending(name))
        ends = ["/".join(path.parts[start:]) for start in range(len(path.parts))]
        named = next((self.named[end] for end in ends if end in self.named), None)
        if named is not None:
            return named
        return next((cut for pattern, cut in self.patterns if any(fnmatchcase(end, pattern) for end in ends)), None)


@dataclass(frozen=True)
class FrameCuts:
    """All tables of a data folder."""

    tables: tuple[tuple[str, CutTable], ...] = ()
    """The folder that each is for, as a path below the data folder, `` for all of it; the first that fits counts."""

    def find(self, name: str) -> Cut | None:
        """The cut of the file of this path below the data folder, or None."""
        return self._find_with_table(name)[1]

    def describe(self, names: Sequence[str]) -> tuple[str, ...]:
        """For each table that names some of these files its path and how many, as `Frame_Cuts.csv: 3 of 4 clips`."""
        counts = Counter(table for table, _ in map(self._find_with_table, names) if table)
        return tuple(f"{table}: {count} of {len(names)} clips" for table, count in counts.items())

    def _find_with_table(self, name: str) -> tuple[str, Cut | None]:
        """The cut, and the path of its table below the data folder; an empty path without one."""
        for folder, table in self.tables:
            cut = table.find(name.removeprefix(folder)) if name.startswith(folder) else None
            if cut is not None:
                return f"{folder}{table.file.name}", cut
        return "", None


def find_cuts(data: Path, given: Path | None) -> FrameCuts:
    """The table that was given, for all files, before every `Frame_Cuts.csv` in the data folder and below it.

    `cmu` is the table that comes with mapctl, unless a file is called so. FileFormatError names the row that makes no
    sense.
    """
    if given is not None and given == CMU and not given.exists():
        given = _CMU_TABLE
    tables = [] if given is None else [("", read_cuts(given))]
    own = None if given is None else given.resolve()
    for folder, folders, files in os.walk(data, onerror=lambda error: None):
        folders.sort()
        for name in sorted(files):
            file = Path(folder) / name
            if name.lower() == TABLE_NAME.lower() and file.resolve() != own:
                below = file.parent.relative_to(data).as_posix()
                tables.append(("" if below == "." else f"{below}/", read_cuts(file)))
    return FrameCuts(tuple(tables))


def read_cuts(path: Path) -> CutTable:
    """A table of file, first and last frame (from 0, the last included), or that of 100STYLE (Mason et al. 2022).

    The latter has a row a style, STYLE_NAME, and by kind of clip, as FW for the file STYLE_FW.bvh, the columns FW_START
    and FW_STOP; the frame at STOP is not taken. FileFormatError names file and line.
    """
    rows = read_table(path, _EXPECTED)
    if not rows:
        raise FileFormatError(path, f"holds no row, expected {_EXPECTED}")
    (line, head), *rows = rows
    columns = [word.lower() for word in head]
    if columns[0] == _STYLE:
        found = _read_style_rows(path, head, rows)
    elif tuple(columns) == _COLUMNS:
        found = _read_file_rows(path, rows)
    else:
        raise FileFormatError(path, f"has the columns {', '.join(head)}, expected {_EXPECTED}", line)
    named: dict[str, Cut] = {}
    patterns = []
    for number, name, cut in found:
        if any(sign in name for sign in "*?["):
            patterns.append((name, cut))
        elif name in named:
            raise FileFormatError(path, f"{name} has a row already: {named[name].where}", number)
        else:
            named[name] = cut
    return CutTable(path, named, tuple(patterns))


def _read_file_rows(path: Path, rows: list[tuple[int, list[str]]]) -> list[tuple[int, str, Cut]]:
    found = []
    for line, words in rows:
        if len(words) != len(_COLUMNS) or not words[0]:
            raise FileFormatError(path, f"a row is file, first, last, got {', '.join(words)}", line)
        name = _strip_ending(words[0].replace("\\", "/"))
        last = _parse_frame(path, line, words[2])
        found.append((line, name, _make_cut(path, line, name, words[1], None if last is None else last + 1)))
    return found


def _read_style_rows(path: Path, head: list[str], rows: list[tuple[int, list[str]]]) -> list[tuple[int, str, Cut]]:
    place = {word.upper(): column for column, word in enumerate(head)}
    kinds = [word.removesuffix("_START") for word in place if word.endswith("_START")]
    lacking = [f"{kind}_STOP" for kind in kinds if f"{kind}_STOP" not in place]
    if lacking or not kinds:
        raise FileFormatError(
            path, f"lacks the column {lacking[0] if lacking else 'FW_START'}, expected {_EXPECTED}", 1
        )
    found = []
    for line, words in rows:
        if len(words) != len(head) or not words[0]:
            raise FileFormatError(path, f"has {len(words)} columns, but {len(head)} in its head", line)
        for kind in kinds:
            start, stop = words[place[f"{kind}_START"]], words[place[f"{kind}_STOP"]]
            if start.lower() in _NONE and stop.lower() in _NONE:
                continue  # there is no such clip
            name = f"{words[0]}_{kind}"
            found.append((line, name, _make_cut(path, line, name, start, _parse_frame(path, line, stop))))
    return found


def _make_cut(path: Path, line: int, name: str, first: str, stop: int | None) -> Cut:
    begin = _parse_frame(path, line, first) or 0
    if stop is not None and stop <= begin:
        raise FileFormatError(path, f"{name} ends at frame {stop - 1}, before it begins, at {begin}", line)
    return Cut(begin, stop, f"{path.name}, line {line},")


def _parse_frame(path: Path, line: int, word: str) -> int | None:
    """A frame, or None where the cell is empty."""
    if word.lower() in _NONE:
        return None
    value = finite_number(word)
    if value is None or value < 0 or value != int(value):
        raise FileFormatError(path, f"a frame is a whole number from 0, got {word!r}", line)
    return int(value)


def _strip_ending(name: str) -> str:
    return name[:-4] if name.lower().endswith(".bvh") else name


STEEPEST = 0.05
"""Largest slope that is taken for a fault of the capture, metres a metre."""
_STILL = 0.25  # m/s of a toe that stands
_ROUGH = 0.015  # metres rms of standing toes about the plane, beyond which they stand on stairs or things
_FEW = 12  # standing toes that tell a plane
_NEAR = 0.01  # metres; what is further from the plane counts less
_USUAL = 0.02  # slope, metres a metre: across a straight walk nothing tells it, and it shall be none


def stand_on_canonical(motion: Motion, rigmap: RigMap) -> Motion:
    """Return a motion on canonical joints (from `to_canonical` with this map) on the canonical bones and a level floor.

    What slopes is turned level as a whole, and each toe then rests as high as the canonical one; hips and steps are in
    the scale of the legs (see `mapctl.retarget.carry`).
    """
    leveled = _put_on_floor(turn_level(motion, find_floor_slope(motion)))
    giver = RiggedCharacter(rigmap, Stance.of(leveled, rigmap))
    return retarget_canonical(leveled, giver, _canonical_body()).motion


def find_floor_slope(motion: Motion) -> Float[Tensor, "2"]:
    """Find by how much the floor rises along x and z, metres a metre, from where toes stand in a canonical motion.

    A plane for each toe, of one slope, is fitted with weights that fall with the distance from it. Zero where too few
    toes stand, where they stand on no plane, or on one steeper than STEEPEST.
    """
    toes = motion.joint_positions()[:, list(TOE_JOINTS)]
    still = torch.diff(toes, dim=0).norm(dim=-1) * float(motion.fps) < _STILL
    none = torch.zeros(2, dtype=torch.float64)
    if int(still.sum()) < _FEW:
        return none
    places, which = toes[1:][still], still.nonzero()[:, 1]
    slope, rough = _fit_plane(places, which == 0)
    return slope if rough < _ROUGH and float(slope.norm()) < STEEPEST else none


def _fit_plane(places: Float[Tensor, "points 3"], left: Bool[Tensor, " points"]) -> tuple[Float[Tensor, "2"], float]:
    """Slope along x and z, and the weighted rms distance from the plane, metres."""
    ground, height = places[:, ::2] - places[:, ::2].mean(dim=0), places[:, 1]
    known = torch.cat([left[:, None], ~left[:, None], ground], dim=1).double()
    usual = torch.diag(torch.tensor([1e-9, 1e-9, 1.0, 1.0], dtype=torch.float64)) * (_NEAR / _USUAL) ** 2
    weight = torch.ones_like(height)
    found, off = torch.zeros(known.shape[1]).double(), height
    for _ in range(10):
        weighted = known * weight[:, None]
        found = torch.linalg.solve(known.T @ weighted + usual, weighted.T @ height)
        off = height - known @ found
        weight = 1 / (1 + (off / _NEAR).square())
    return found[2:], float((weight * off.square()).sum().div(weight.sum()).sqrt())


def turn_level(motion: Motion, slope: Float[Tensor, "2"]) -> Motion:
    """Turn the whole motion so that a floor with this slope (metres a metre along x and z) is level; headings stay."""
    size = float(slope.norm())
    if size == 0:
        return motion
    # About the line in the floor that is level: what points up the slope goes down.
    axis = torch.tensor([-float(slope[1]), 0.0, float(slope[0])], dtype=torch.float64) / size
    turn = rotations.from_rotation_vector(-torch.atan(slope.norm()) * axis).expand(motion.num_frames, 4)
    middle = motion.root_position.mean(dim=0)
    middle[1] = 0
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(turn, local[:, 0])
    root = rotations.rotate(turn, motion.root_position - middle) + middle
    return replace(motion, root_position=root, local_quat_xyzw=local)


def _put_on_floor(motion: Motion) -> Motion:
    """Shift up or down until toes rest about as high as they should: what is far off counts as a platform else."""
    seen = estimate_floor_heights(motion.joint_positions()[:, list(TOE_JOINTS)])
    root = motion.root_position.clone()
    root[:, 1] -= (seen - Stance.at_rest(motion.skeleton).toe_height).min()
    return replace(motion, root_position=root)


@cache
def _canonical_body() -> RiggedCharacter:
    return RiggedCharacter(identify_rig(CANONICAL), Stance.at_rest(CANONICAL))


MIN_CLIPS_TO_SPLIT = 5
"""Clips under which parts of one clip are held out instead of whole clips."""
MIN_CLIP_FRAMES = 75
"""Frames that the longest clip of each part must have at least: free runs and starts warm up on it, 2.5 s."""


@dataclass(frozen=True)
class SkippedFile:
    """A file that cannot be used."""

    name: str
    """Its path below the data folder."""
    reason: str
    """Why, without the name."""


@dataclass(frozen=True, eq=False)
class Corpus:
    """Features of many clips, one after the other."""

    names: tuple[str, ...]
    """Clip names: the files' paths below the data folder."""
    lengths: tuple[int, ...]
    """Frames of each clip."""
    features: Float[Tensor, "frames size"]
    """All frames, float32, physical units."""
    skipped: tuple[SkippedFile, ...] = ()
    """Files of the same folder that are not among the clips."""
    cuts: tuple[str, ...] = ()
    """For each table of frames that was used, its name and of how many of the clips it takes a part."""

    def identity(self) -> dict[str, str]:
        """What tells this corpus from others: its size, and short hashes of names, lengths and features."""
        hashed = {
            "clip names": repr(self.names).encode(),
            "clip lengths": repr(self.lengths).encode(),
            "features": self.features.contiguous().numpy().tobytes(),
        }
        size = {"clips": str(len(self.names)), "frames": str(len(self.features))}
        return size | {name: sha256(content).hexdigest()[:12] for name, content in hashed.items()}

    def describe_selection(self) -> dict[str, dict[str, str] | list[str]]:
        """Describe the files that were left out and why, and the tables that say which frames are motion, for a card;
        nothing where there are none."""
        found: dict[str, dict[str, str] | list[str]] = {}
        if self.skipped:
            found["skipped"] = {file.name: file.reason for file in self.skipped}
        if self.cuts:
            found["cuts"] = list(self.cuts)
        return found

    def clips(self) -> list[Float[Tensor, "frames size"]]:
        """The features of each clip."""
        return list(self.features.split(list(self.lengths)))

    def locate_clips(self) -> tuple[Int[Tensor, " clips"], Int[Tensor, " clips"]]:
        """The number of frames of each clip, and where it starts."""
        lengths = torch.tensor(self.lengths)
        return lengths, torch.cumsum(lengths, 0) - lengths

    def integrate_roots(self) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, " frames"]]:
        """The hips' position on the ground and their heading in every frame, each clip from the origin."""
        origin = GroundPose(torch.zeros(2), torch.zeros(()))
        ground, heading = zip(*(integrate_root(clip, origin) for clip in self.clips()), strict=True)
        return torch.cat(ground), torch.cat(heading)

    def to(self, device: str) -> "Corpus":
        """The corpus with its features on a device of torch's."""
        return replace(self, features=self.features.to(device))

    def subset(self, picked: Iterable[int]) -> "Corpus":
        """The corpus of some clips."""
        picked, clips = list(picked), self.clips()
        return Corpus(
            tuple(self.names[i] for i in picked),
            tuple(self.lengths[i] for i in picked),
            torch.cat([clips[i] for i in picked]),
        )


@dataclass(frozen=True, eq=False)
class Split:
    """Parts of a corpus. What is trained on is in no other."""

    train: Corpus
    """90 % of the clips."""
    validation: Corpus
    """5 %, for the curve."""
    test: Corpus
    """5 %, for the measures of the card; of few clips the very part that `validation` is."""

    def to(self, device: str) -> "Split":
        """All parts on a device of torch's."""
        return Split(self.train.to(device), self.validation.to(device), self.test.to(device))


def split_corpus(corpus: Corpus, seed: int) -> Split:
    """Split by clip, 90/5/5, drawn with the seed; a small corpus keeps at least one clip in each part.

    Of fewer than MIN_CLIPS_TO_SPLIT clips none can be spared: the end of the longest is held out, a tenth of all frames
    and MIN_CLIP_FRAMES at least, for validation and test alike. RequestError for fewer than three clips long enough to
    warm up on.
    """
    count = len(corpus.names)
    if count < MIN_CLIPS_TO_SPLIT:
        return _split_by_frames(corpus)
    drawn = torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()
    held = max(1, round(0.05 * count))
    parts = [drawn[2 * held :], drawn[:held], drawn[held : 2 * held]]
    _exchange_short(parts, corpus.lengths)
    return Split(*(corpus.subset(sorted(part)) for part in parts))


def _exchange_short(parts: Sequence[list[int]], lengths: Sequence[int]) -> None:
    """Where a part has only clips too short to warm up on, give it the first long one of a part that has several, in
    exchange. RequestError for fewer long ones than parts."""
    long = [[i for i in part if lengths[i] >= MIN_CLIP_FRAMES] for part in parts]
    if sum(map(len, long)) < len(parts):
        raise RequestError(
            f"training, validation and test need a clip of {MIN_CLIP_FRAMES} frames at {PRIOR_FPS} fps each;"
            f" {sum(map(len, long))} of {len(lengths)} clips are that long"
        )
    for part, own in zip(parts, long, strict=True):
        if not own:
            giver = max(range(len(parts)), key=lambda number: len(long[number]))
            taken = long[giver].pop(0)
            parts[giver][parts[giver].index(taken)] = part[0]
            part[0] = taken


def _split_by_frames(corpus: Corpus) -> Split:
    at = corpus.lengths.index(longest := max(corpus.lengths))
    held = max(MIN_CLIP_FRAMES, round(0.1 * len(corpus.features)))
    lengths = tuple(length - held * (number == at) for number, length in enumerate(corpus.lengths))
    if longest < held or max(lengths) < MIN_CLIP_FRAMES:
        raise RequestError(
            f"training needs {MIN_CLIP_FRAMES} frames at {PRIOR_FPS} fps, and {held} to hold out in the longest clip;"
            f" got clips of {', '.join(map(str, corpus.lengths))}"
        )
    clips = corpus.clips()
    kept = [number for number, length in enumerate(lengths) if length > 1]
    train = Corpus(
        tuple(corpus.names[i] for i in kept),
        tuple(lengths[i] for i in kept),
        torch.cat([clips[i][: lengths[i]] for i in kept]),
    )
    # Whoever looks for clips by their names shall not take the clip that was trained on for one that was not.
    end = Corpus((f"{corpus.names[at]}[{lengths[at]}:{longest}]",), (held,), clips[at][lengths[at] :])
    return Split(train, end, end)


@dataclass(frozen=True)
class ClipReader:
    """Reads the clips of a folder."""

    data: Path
    """The folder."""
    cuts: FrameCuts
    """Which frames are motion."""
    level: bool = False
    """Put every clip on the canonical body and a level floor."""

    def name(self, file: Path) -> str:
        """The name of the clip: the file's path below the folder."""
        return file.relative_to(self.data).as_posix()

    def read(self, file: Path) -> Float[Tensor, "frames size"] | str:
        """The clip, or why there is none. What no reader foresaw is a reason too: one file must not end a run."""
        try:
            cut = self.cuts.find(self.name(file))
            return read_clip_features(file, cut=cut, level=self.level)
        except (MapctlError, OSError) as error:
            # The list has the name already.
            return " ".join(str(error).split()).removeprefix(str(file)).lstrip(":, ")
        except Exception as error:
            return f"{type(error).__name__}: {' '.join(str(error).split())}"


def read_clip_features(file: Path, *, cut: Cut | None = None, level: bool = False) -> Float[Tensor, "frames size"]:
    """One file as features at 30 fps on the canonical joints; MapctlError, naming it, where that cannot be.

    The rig is told from all of the file: a T-pose that is cut off may be what shows it. Bones and floor are the
    performer's, or with `level` the canonical ones.
    """
    motion = load(file)
    try:
        rig = None if cut is None else retarget.as_rig(retarget.identify_rig(motion.skeleton, motion=motion))
        if cut is not None:
            motion = cut.apply(motion)
        canonical, rigmap = retarget.to_canonical(motion, rig)
        canonical = canonical.resample(PRIOR_FPS)
        features = encode(stand_on_canonical(canonical, rigmap) if level else canonical)[0].float()
        if not bool(torch.isfinite(features).all()):
            raise MapctlError("its motion is not finite")
        return features
    except MapctlError as error:
        raise MapctlError(f"{file}: {error}") from error


def read_corpus(
    data: Path,
    *,
    match: str,
    cache: Path,
    cuts: Path | None = None,
    level: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Corpus:
    """Every BVH below `data` whose path matches the pattern, as features at 30 fps; from the cache where it is fresh.

    Files that cannot be read or fit no known rig are left out, and listed in the corpus; RequestError where no other
    is left. Of files that a table names, `cuts` or one found in
    the folder (see `find_cuts`), only the frames that it says are taken. `level` puts every clip on the canonical body
    and a level floor (see `stand_on_canonical`).
    """
    try:
        pattern = re.compile(match)
    except re.error as error:
        raise RequestError(f"match must be a regular expression, got {match!r} ({error})") from error
    found, closed = _list_files(data)
    files = [file for file in found if pattern.search(file.relative_to(data).as_posix())]
    if not files:
        unread = f"; {closed[0].name} cannot be read ({closed[0].reason})" if closed else ""
        matching = f" matches {match!r}" if found else ""
        raise RequestError(f"no .bvh below {data}{matching}{unread}")
    reader = ClipReader(data, find_cuts(data, cuts), level)
    key = _compute_cache_key(data, files, reader)
    stored = cache / f"corpus-{key}.safetensors"
    corpus = read_cache(stored)
    if corpus is None or any(not isinstance(reader.read(data / file.name), str) for file in corpus.skipped):
        corpus = _read_files(files, reader, progress or (lambda done, total: None))
        write_cache(corpus, stored)
    return replace(corpus, skipped=(*corpus.skipped, *closed), cuts=reader.cuts.describe(corpus.names))


def _list_files(data: Path) -> tuple[list[Path], list[SkippedFile]]:
    """All .bvh below a folder, sorted, and the folders below it that cannot be looked into."""
    closed: list[OSError] = []
    found = [
        Path(folder) / name
        for folder, folders, files in os.walk(data, onerror=closed.append)
        for name in (*files, *folders)
        if name.lower().endswith(".bvh")
    ]
    skipped = [
        SkippedFile(Path(error.filename or data).relative_to(data).as_posix(), f"{error.strerror or error}")
        for error in closed
    ]
    return sorted(found), skipped


def _read_files(files: Sequence[Path], reader: ClipReader, progress: Callable[[int, int], None]) -> Corpus:
    clips, names, skipped = [], [], []
    for number, file in enumerate(files, start=1):
        name, found = reader.name(file), reader.read(file)
        if isinstance(found, str):
            skipped.append(SkippedFile(name, found))
        else:
            clips.append(found)
            names.append(name)
        progress(number, len(files))
    if not clips:
        first = f"{reader.data / skipped[0].name}: {skipped[0].reason}"
        raise RequestError(f"none of the {len(files)} .bvh below {reader.data} can be trained on ({first})")
    return Corpus(tuple(names), tuple(len(c) for c in clips), torch.cat(clips), tuple(skipped))


def find_window_starts(lengths: tuple[int, ...], window: int) -> Int[Tensor, " starts"]:
    """Index into the joined frames of every window that lies within one clip."""
    starts, first = [], 0
    for length in lengths:
        starts.append(torch.arange(first, first + max(0, length - window + 1)))
        first += length
    starts = torch.cat(starts)
    if len(starts) == 0:
        raise RequestError(f"no clip is as long as the window of {window} frames")
    return starts


def number_clip_folders(corpus: Corpus) -> Int[Tensor, " clips"]:
    """By clip the number of the top folder that it lies in."""
    folders = [name.split("/")[0] for name in corpus.names]
    number = {folder: index for index, folder in enumerate(sorted(set(folders)))}
    return torch.tensor([number[folder] for folder in folders])


def _compute_cache_key(data: Path, files: list[Path], reader: ClipReader) -> str:
    """Hash everything that the features depend on: files and their cuts, rig tables, contact thresholds, layout and
    rate."""
    parts = [LAYOUT.fingerprint(), str(PRIOR_FPS), repr(rigs.known_rigs()), repr(ContactSettings())]
    parts += [*["level"] * reader.level, *(f"{f.relative_to(data)} {_read_file_stamp(f)}" for f in files)]
    cuts = [(reader.name(file), reader.cuts.find(reader.name(file))) for file in files]
    parts += [f"{name} {cut.first} {cut.stop}" for name, cut in cuts if cut is not None]
    return sha256("\n".join(parts).encode(errors="surrogateescape")).hexdigest()[:16]


def _read_file_stamp(file: Path) -> str:
    """Size and time; of a link that leads nowhere nothing."""
    try:
        found = file.stat()
    except OSError:
        return "-"
    return f"{found.st_size} {found.st_mtime_ns}"


def read_cache(stored: Path) -> Corpus | None:
    """Read a corpus that was kept: its clips, and the files that were left out. None where there is none, or only a
    damaged one."""
    try:
        with safe_open(stored, framework="pt") as file:
            index = json.loads(file.metadata()["index"])
            corpus = Corpus(
                tuple(index["names"]),
                tuple(index["lengths"]),
                file.get_tensor("features"),
                tuple(SkippedFile(*row) for row in index["skipped"]),
            )
    except (OSError, SafetensorError, ValueError, KeyError, TypeError):
        return None
    whole = len(corpus.names) == len(corpus.lengths) and sum(corpus.lengths) == len(corpus.features)
    return corpus if whole else None


def write_cache(corpus: Corpus, stored: Path) -> None:
    """Keep the clips of a corpus, and the files that were left out, in a file; its folder is made if there is none."""
    stored.parent.mkdir(parents=True, exist_ok=True)
    index = json.dumps(
        {
            "names": corpus.names,
            "lengths": corpus.lengths,
            "skipped": [(file.name, file.reason) for file in corpus.skipped],
        }
    )
    write_tensors(stored, {"features": corpus.features}, metadata={"index": index})


def measure_speeds(corpus: Corpus) -> list[Float[Tensor, " frames"]]:
    """Measure the speeds of the hips over the ground by clip, without the sway within a stride, m/s."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    return [torch.from_numpy(measure_speed(part.numpy(), PRIOR_FPS)).float() for part in parts]


def follow_paces(corpus: Corpus) -> Int[Tensor, " frames"]:
    """Follow the pace of all clips, joined: the index in PACES of each frame."""
    return torch.cat([torch.from_numpy(follow_pace(speed.numpy())) for speed in measure_speeds(corpus)])


def measure_pace_changes(corpus: Corpus) -> dict[str, Any]:
    """Measure minutes by pace (stand, walk, run) and how often the clips change from one pace to another, for a card
    (see `priors.lstm_gmm.density`)."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    speeds = [measure_speed(part.double().numpy(), PRIOR_FPS) for part in parts]
    pace = np.bincount(np.concatenate([follow_pace(speed) for speed in speeds]), minlength=len(PACES))
    changes = sum((count_pace_changes(speed) for speed in speeds), PaceChanges())
    minutes = {name: round(int(count) / PRIOR_FPS / 60, 2) for name, count in zip(PACES, pace, strict=True)}
    return {"minutes by pace": minutes, **{name: float(count) for name, count in changes.by_name().items()}}
