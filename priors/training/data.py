"""A folder of motion files as training features: read once, cached, split by clip."""

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.contacts import ContactSettings, estimate_floor_heights
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root, mirror_features
from mapctl.formats import load
from mapctl.formats.text import read_table
from mapctl.metrics.gait import CHANGES, PACES, count_pace_changes, follow_pace, measure_speed
from mapctl.motion import Motion
from mapctl.retarget import RigMap, identify_rig, rigs
from mapctl.retarget.carry import RiggedCharacter, retarget_canonical
from mapctl.retarget.character import Stance
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.checkpoints import write_tensors

MIN_CLIPS_TO_SPLIT = 5
"""Clips under which parts of one clip are held out instead of whole clips."""
MIN_CLIP_FRAMES = 75
"""Frames that the longest clip of each part must have at least: free runs and starts warm up on it, 2.5 s."""


@dataclass(frozen=True, eq=False)
class Corpus:
    """Features of many clips, one after the other."""

    names: tuple[str, ...]  # clip names: the files' paths below the data folder
    lengths: tuple[int, ...]  # frames of each clip
    features: Float[Tensor, "frames size"]  # all frames, float32, physical units
    skipped: dict[str, str] = field(default_factory=dict)  # why files of the folder are not among the clips, by path
    cuts: tuple[str, ...] = ()  # tables of frames that were used, and of how many clips each takes a part

    def identity(self) -> dict[str, str]:
        """Return what distinguishes this corpus: its size, and short hashes of names, lengths and features."""
        hashed = {
            "clip names": repr(self.names).encode(),
            "clip lengths": repr(self.lengths).encode(),
            "features": self.features.contiguous().numpy().tobytes(),
        }
        size = {"clips": str(len(self.names)), "frames": str(len(self.features))}
        return size | {name: sha256(content).hexdigest()[:12] for name, content in hashed.items()}

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
        names, lengths = tuple(self.names[i] for i in picked), tuple(self.lengths[i] for i in picked)
        return Corpus(names, lengths, torch.cat([clips[i] for i in picked]))


@dataclass(frozen=True, eq=False)
class Split:
    """A corpus and its parts. What is trained on is in no other."""

    whole: Corpus  # all clips
    train: Corpus  # 90 % of the clips
    validation: Corpus  # 5 %, for the curve
    test: Corpus  # 5 %, for the measures of the card; of few clips the very part that `validation` is

    def to(self, device: str) -> "Split":
        """All parts on a device of torch's."""
        return Split(self.whole, self.train.to(device), self.validation.to(device), self.test.to(device))


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
    # A part of clips too short to warm up on gets a long one of the part that has most, in exchange.
    long = [[i for i in part if corpus.lengths[i] >= MIN_CLIP_FRAMES] for part in parts]
    if sum(map(len, long)) < len(parts):
        raise RequestError(
            f"training, validation and test need a clip of {MIN_CLIP_FRAMES} frames at {PRIOR_FPS} fps each;"
            f" {sum(map(len, long))} of {count} clips are that long"
        )
    for part, own in zip(parts, long, strict=True):
        if not own:
            donor = max(range(len(parts)), key=lambda number: len(long[number]))
            taken = long[donor].pop(0)
            parts[donor][parts[donor].index(taken)] = part[0]
            part[0] = taken
    return Split(corpus, *(corpus.subset(sorted(part)) for part in parts))


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
    # Another name: this clip is not the one that was trained on.
    end = Corpus((f"{corpus.names[at]}[{lengths[at]}:{longest}]",), (held,), clips[at][lengths[at] :])
    return Split(corpus, train, end, end)


def read_corpus(
    data: Path,
    *,
    match: str,
    cache: Path,
    cuts: Path | None = None,
    level: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> Corpus:
    """Read every BVH below `data` whose path matches the pattern, as features at 30 fps; from the cache where it is
    fresh.

    Files that cannot be read or fit no known rig are left out, and listed in the corpus; RequestError where no other
    is left. Of files that a table names, `cuts` or one found in the folder (see `FrameCuts`), only the frames that it
    names are taken. `level` puts every clip on the canonical body and a level floor (see `stand_on_canonical`).
    """
    try:
        pattern = re.compile(match)
    except re.error as error:
        raise RequestError(f"match must be a regular expression, got {match!r} ({error})") from error
    skipped: dict[str, str] = {}

    def note_closed(error: OSError) -> None:
        skipped[Path(error.filename or data).relative_to(data).as_posix()] = error.strerror or str(error)

    found = [Path(folder) / name for folder, _, files in os.walk(data, onerror=note_closed) for name in files]
    found = sorted(file for file in found if file.suffix.lower() == ".bvh")
    files = {file.relative_to(data).as_posix(): file for file in found}
    files = {name: file for name, file in files.items() if pattern.search(name)}
    if not files:
        matching = f" matches {match!r}" if found else ""
        unread = "".join(f"; {name}: {reason}" for name, reason in skipped.items())
        raise RequestError(f"no .bvh below {data}{matching}{unread}")
    tables = FrameCuts.of_folder(data, cuts)
    stored = cache / f"corpus-{_compute_cache_key(files, tables, level)}.safetensors"
    corpus = _read_cache(stored)
    if corpus is None:
        corpus = _read_files(data, files, tables, level, report)
        stored.parent.mkdir(parents=True, exist_ok=True)
        index = json.dumps([corpus.names, corpus.lengths, corpus.skipped])
        write_tensors(stored, {"features": corpus.features}, metadata={"index": index})
    used = Counter(table for table, _ in map(tables.find, corpus.names) if table)
    described = tuple(f"{table}: {count} of {len(corpus.names)} clips" for table, count in used.items())
    for line in described:
        report(f"frames by {line}")
    return replace(corpus, skipped=corpus.skipped | skipped, cuts=described)


def _read_files(
    data: Path, files: dict[str, Path], tables: "FrameCuts", level: bool, report: Callable[[str], None]
) -> Corpus:
    clips, skipped = {}, {}
    for number, (name, file) in enumerate(files.items(), start=1):
        try:
            clips[name] = read_clip_features(file, cut=tables.find(name)[1], level=level)
        except (MapctlError, OSError) as error:
            skipped[name] = " ".join(str(error).split()).removeprefix(str(file)).lstrip(":, ")
        except Exception as error:  # what no reader foresaw: one file must not end a run
            skipped[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
        if number % 200 == 0 or number == len(files):
            report(f"read {number} of {len(files)} clips")
    if not clips:
        first, reason = next(iter(skipped.items()))
        raise RequestError(f"none of the {len(files)} .bvh below {data} can be trained on ({data / first}: {reason})")
    return Corpus(tuple(clips), tuple(map(len, clips.values())), torch.cat(list(clips.values())), skipped)


def read_clip_features(file: Path, *, cut: "Cut | None" = None, level: bool = False) -> Float[Tensor, "frames size"]:
    """Read one file as features at 30 fps on the canonical joints; MapctlError, naming it, where that cannot be.

    The rig is recognised from all of the file: a T-pose that is cut off may be what shows it. Bones and floor are the
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


def _compute_cache_key(files: dict[str, Path], tables: "FrameCuts", level: bool) -> str:
    """Hash all that features depend on: files and their cuts, rig tables, contact thresholds, layout and rate."""
    parts = [LAYOUT.fingerprint(), str(PRIOR_FPS), repr(rigs.known_rigs()), repr(ContactSettings()), str(level)]
    for name, file in files.items():
        found = file.stat() if file.exists() else None  # a link may lead nowhere
        parts.append(f"{name} {tables.find(name)[1]} {found and (found.st_size, found.st_mtime_ns)}")
    return sha256("\n".join(parts).encode(errors="surrogateescape")).hexdigest()[:16]


def _read_cache(stored: Path) -> Corpus | None:
    """Read a corpus that was kept; None where there is none, or only a damaged one."""
    try:
        with safe_open(stored, framework="pt") as file:
            names, lengths, skipped = json.loads(file.metadata()["index"])
            corpus = Corpus(tuple(names), tuple(lengths), file.get_tensor("features"), dict(skipped))
    except (OSError, SafetensorError, ValueError, KeyError, TypeError):
        return None
    whole = len(corpus.names) == len(corpus.lengths) and sum(corpus.lengths) == len(corpus.features)
    return corpus if whole else None


CMU = Path("cmu")
"""The name of the table for takes of the CMU database that comes with mapctl, in place of a file of one's own."""
_CMU_TABLE = Path(__file__).with_name("cmu_cuts.csv")
_TABLE_NAME = "frame_cuts.csv"  # in lower case
_COLUMNS = ["file", "first", "last"]
_EXPECTED = "a table of file, first, last, or of STYLE_NAME and a _START and a _STOP column for each kind of clip"
_EMPTY = ("", "n/a", "na", "nan", "-")


class Cut(NamedTuple):
    """The frames of a file that are motion, as the file counts them, from 0 on."""

    first: int
    """First of them."""
    stop: int | None
    """The one after the last of them; None where the file ends."""

    def apply(self, motion: Motion) -> Motion:
        """Only these frames; MapctlError where the file has no such frames."""
        stop = motion.num_frames if self.stop is None else self.stop
        if stop > motion.num_frames or stop - self.first < 2:
            raise MapctlError(f"frames {self.first} to {stop - 1} are to be taken, but it has {motion.num_frames}")
        return motion.slice(self.first, stop)


@dataclass(frozen=True)
class FrameCuts:
    """The tables of a data folder: that of --cuts, then every Frame_Cuts.csv, for the files beside and below it."""

    tables: tuple[tuple[str, str, dict[str, Cut]], ...] = ()
    """The folder that each is for, as a path below the data folder, its file's name, and its rows."""

    @staticmethod
    def of_folder(data: Path, given: Path | None = None) -> "FrameCuts":
        """Read the tables of a folder; FileFormatError names the row that makes no sense."""
        if given is not None and given == CMU and not given.exists():
            given = _CMU_TABLE
        tables = [] if given is None else [("", given.name, read_cuts(given))]
        for folder, _, files in sorted(os.walk(data)):
            for name in files:
                if name.lower() == _TABLE_NAME:
                    below = Path(folder).relative_to(data).as_posix()
                    tables.append(("" if below == "." else f"{below}/", name, read_cuts(Path(folder) / name)))
        return FrameCuts(tuple(tables))

    def find(self, name: str) -> tuple[str, Cut | None]:
        """Return the path of the table that holds for a clip and the cut in it; the first table that has one counts, a
        row that names the file before those with patterns. A row names the path or the end of it."""
        for folder, table, rows in self.tables:
            if name.startswith(folder):
                path = PurePosixPath(_strip_ending(name.removeprefix(folder)))
                ends = ["/".join(path.parts[start:]) for start in range(len(path.parts))]
                fitting = [cut for row, cut in rows.items() if any(fnmatchcase(end, row) for end in ends)]
                named = [rows[end] for end in ends if end in rows]
                if named or fitting:
                    return f"{folder}{table}", (named or fitting)[0]
        return "", None


def read_cuts(path: Path) -> dict[str, Cut]:
    """Read a table of file, first and last frame (from 0, the last included), or that of 100STYLE (Mason et al. 2022),
    by the name of the file without its ending.

    The latter has a row a style, STYLE_NAME, and by kind of clip, as FW for the file STYLE_FW.bvh, the columns FW_START
    and FW_STOP; the frame at STOP is not taken. FileFormatError names file and line.
    """
    (_, head), *rows = read_table(path, _EXPECTED) or [(1, [""])]
    columns = [word.upper() for word in head]
    kinds = [word.removesuffix("_START") for word in columns if word.endswith("_START")]
    styled = columns[0] == "STYLE_NAME" and kinds and all(f"{kind}_STOP" in columns for kind in kinds)
    if not styled and [word.lower() for word in head] != _COLUMNS:
        raise FileFormatError(path, f"has the columns {', '.join(head)}, expected {_EXPECTED}", 1)
    found: dict[str, Cut] = {}
    for line, words in rows:
        if len(words) != len(head) or not words[0]:
            raise FileFormatError(path, f"a row is {', '.join(head)}, got {', '.join(words)}", line)
        name = _strip_ending(words[0].replace("\\", "/"))
        cells = dict(zip(columns, words, strict=True))
        spans = {f"{name}_{kind}": (cells[f"{kind}_START"], cells[f"{kind}_STOP"], 0) for kind in kinds}
        for clip, (start, end, included) in (spans if styled else {name: (words[1], words[2], 1)}).items():
            if styled and start.lower() in _EMPTY and end.lower() in _EMPTY:
                continue  # there is no such clip
            first, stop = (_parse_frame(path, line, word) for word in (start, end))
            cut = Cut(first or 0, None if stop is None else stop + included)
            if clip in found or (cut.stop is not None and cut.stop <= cut.first):
                wrong = "has a row already" if clip in found else "ends before it begins"
                raise FileFormatError(path, f"{clip} {wrong}", line)
            found[clip] = cut
    return found


def _parse_frame(path: Path, line: int, word: str) -> int | None:
    """Parse a frame; None where the cell is empty."""
    if word.lower() in _EMPTY:
        return None
    if re.fullmatch(r"\d{1,9}(\.0*)?", word) is None:
        raise FileFormatError(path, f"a frame is a whole number from 0, got {word!r}", line)
    return int(float(word))


def _strip_ending(name: str) -> str:
    return name[:-4] if name.lower().endswith(".bvh") else name


# Features keep the hips' height and travel of the recorded performer, while priors are decoded on canonical bones. Of
# captures whose floor slopes or whose feet rest at another height, as those of CMU, feet would go through the floor,
# and contacts be found where the floor is lowest alone.
STEEPEST = 0.05
"""Largest slope that is taken for a fault of the capture, metres a metre."""
_STILL = 0.25  # m/s of a toe that stands
_ROUGH = 0.015  # metres rms of standing toes about the plane, beyond which they stand on stairs or things
_FEW = 12  # standing toes that determine a plane
_NEAR = 0.01  # metres; what is further from the plane counts less
_USUAL = 0.02  # slope, metres a metre: across a straight walk nothing determines it, and it shall be 0


def stand_on_canonical(motion: Motion, rigmap: RigMap) -> Motion:
    """Return a motion on canonical joints (from `to_canonical` with this map) on the canonical bones and a level floor.

    What slopes is turned level as a whole, and each toe then rests as high as the canonical one; hips and steps are in
    the scale of the legs (see `mapctl.retarget.carry`).
    """
    turned = turn_level(motion, find_floor_slope(motion))
    # Up or down until toes rest about as high as they should: what is far off counts as a platform else.
    seen = estimate_floor_heights(turned.joint_positions()[:, list(TOE_JOINTS)])
    root = turned.root_position.clone()
    root[:, 1] -= (seen - Stance.at_rest(turned.skeleton).toe_height).min()
    leveled = replace(turned, root_position=root)
    source = RiggedCharacter(rigmap, Stance.of(leveled, rigmap))
    return retarget_canonical(leveled, source, _canonical_body()).motion


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
    positions, which = toes[1:][still], still.nonzero()[:, 1]
    slope, rough = _fit_plane(positions, which == 0)
    return slope if rough < _ROUGH and float(slope.norm()) < STEEPEST else none


def _fit_plane(positions: Float[Tensor, "points 3"], left: Bool[Tensor, " points"]) -> tuple[Float[Tensor, "2"], float]:
    """Slope along x and z, and the weighted rms distance from the plane, metres."""
    ground, height = positions[:, ::2] - positions[:, ::2].mean(dim=0), positions[:, 1]
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


@cache
def _canonical_body() -> RiggedCharacter:
    return RiggedCharacter(identify_rig(CANONICAL), Stance.at_rest(CANONICAL))


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


def compute_feature_statistics(features: Float[Tensor, "frames size"]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of features and their mirror image; floors keep held joints from exploding.

    Rotations are held to at least 0.01 rad (0.6 degrees), displacements to 1 mm; contact bits map to -1 and 1.
    """
    both = torch.cat([features, mirror_features(features)])
    mean, std = both.mean(0), both.std(0)
    floor = torch.full_like(std, 0.01)
    floor[LAYOUT.slices["root_displacement_heading"]] = 0.001
    floor[LAYOUT.slices["heading_change"]] = 0.002
    for values in (mean, floor, std):
        values[LAYOUT.slices["contacts"]] = 0.5
    return mean, torch.maximum(std, floor)


def _follow_speeds(corpus: Corpus) -> list[NDArray[np.floating]]:
    """Follow the speeds of the hips over the ground by clip, without the sway within a stride, m/s."""
    parts = corpus.integrate_roots()[0].split(list(corpus.lengths))
    return [measure_speed(part.double().numpy(), PRIOR_FPS) for part in parts]


def follow_paces(corpus: Corpus) -> Int[Tensor, " frames"]:
    """Follow the pace of all clips, joined: the index in PACES of each frame."""
    return torch.from_numpy(np.concatenate([follow_pace(speed) for speed in _follow_speeds(corpus)]))


def measure_pace_changes(corpus: Corpus) -> dict[str, Any]:
    """Measure minutes by pace (stand, walk, run) and how often the clips change from one pace to another, for a card
    (see `priors.lstm_gmm.density`)."""
    speeds = _follow_speeds(corpus)
    pace = np.bincount(np.concatenate([follow_pace(speed) for speed in speeds]), minlength=len(PACES))
    changes = [count_pace_changes(speed) for speed in speeds]
    minutes = {name: round(int(count) / PRIOR_FPS / 60, 2) for name, count in zip(PACES, pace, strict=True)}
    return {
        "minutes by pace": minutes,
        **{name: float(sum(clip[name] for clip in changes)) for name in CHANGES.values()},
    }
