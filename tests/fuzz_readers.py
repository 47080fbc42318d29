"""Every reader on broken files: one of mapctl's errors, or a sound result; never anything else, slow or large.

    python tests/fuzz_readers.py [READER...] --cases 2000 --seed 1 --folder FOLDER

breaks small files of every kind, and those of up to 200 kB below FOLDER. Reader, seed and number alone decide what a
case is, so that a failure can be repeated: READER --seed S --only N.
"""

import argparse
import io
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from forked_readers import fork_readers
from fuzz_checks import (
    Broken,
    check_commands,
    check_curve,
    check_model,
    check_motion_file,
    check_npz,
    check_rig,
    check_rows,
    require,
)
from fuzz_samples import Sample, make_copies, make_gltf, make_models, make_motions, make_pairs, make_tables
from mutations import mutate

from mapctl import formats
from mapctl.errors import MapctlError
from mapctl.intent.drawing_csv import read_drawing
from mapctl.intent.keyframe_toml import read_keys
from mapctl.intent.shot_keys import read_shot_keys
from mapctl.recording.masks import load_masks
from priors.training.mocap.cuts import read_cuts
from scenes import scene_file

SLOWEST_SECONDS, MOST_MEGABYTES = 4.0, 600
"""Bounds on one case: its time, and what it adds to the peak of memory."""
_PROCESSES = 5  # that read one file of some kinds, one after the other: clip, mesh, rest pose, written, again


@dataclass(frozen=True)
class Reader:
    """A kind of file: how it is read, and sound files of it."""

    file: str
    """Name of the file that is broken."""
    check: Callable[[Path], object]
    """Reads the file of this path, and raises Broken where the result is unsound."""
    make: Callable[[Path], Iterator[tuple[str, bytes] | Sample]]
    """Makes sound files, given an empty folder."""
    container: str = "text"
    """Structure that is mutated: of `mutations.CONTAINERS`."""
    is_isolated: bool = False
    """Whether it is read in processes of its own."""


def _motion_reader(ending: str) -> Reader:
    module = formats.READERS[ending]
    make = {".gltf": make_gltf}.get(ending, partial(make_motions, ending=ending))
    container = {"npz": "npz", "gltf": "glb", "fbx": "binary", "usd": "binary"}
    return Reader(
        f"x{ending}",
        check_npz if ending == ".npz" else check_motion_file,
        partial(make_pairs, ending=ending) if module == "acclaim" else make,
        "json" if ending == ".gltf" else container.get(module, "text"),
        module in ("usd", "fbx"),
    )


def _table_reader(name: str, check: Callable[[Path], object], container: str = "text") -> Reader:
    return Reader(f"x.{name.rpartition('.')[2]}", check, partial(make_tables, ending=name), container)


def _copied_reader(pattern: str, check: Callable[[Path], object]) -> Reader:
    return Reader("x.toml", check, partial(make_copies, pattern=pattern), "toml")


READERS: dict[str, Reader] = {
    **{ending.lstrip("."): _motion_reader(ending) for ending in formats.READERS},
    "asf": Reader(
        "x.asf", lambda path: check_motion_file(path.with_suffix(".amc")), partial(make_pairs, ending=".asf")
    ),
    "rig.toml": _copied_reader("mapctl/retarget/presets/*.toml", check_rig),
    "scene.toml": _copied_reader("scenes/*.toml", scene_file.load),
    "keys.toml": _copied_reader("docs/inputs/*.toml", read_keys),
    "shot.toml": _table_reader("shot.toml", read_shot_keys, "toml"),
    "steering.csv": _table_reader("steering.csv", check_commands),
    "curve.csv": _table_reader("curve.csv", check_curve),
    "curve.svg": _table_reader("curve.svg", check_curve),
    "masks.csv": _table_reader("masks.csv", partial(check_rows, load_masks)),
    "drawing.csv": _table_reader("drawing.csv", read_drawing),
    "cuts.csv": _table_reader("cuts.csv", read_cuts),
    "card": Reader("x.json", check_model, partial(make_models, ending=".json"), "json"),
    "weights": Reader("x.safetensors", check_model, partial(make_models, ending=".safetensors"), "safetensors"),
}
"""Every reader of files that a user gives, by the name of its kind; endings of `formats.READERS` by themselves."""


@cache
def samples(name: str, folder: Path | None = None) -> tuple[Sample, ...]:
    """Make sound files of a reader, and read those below the folder."""
    with tempfile.TemporaryDirectory() as made:
        found = [s if isinstance(s, Sample) else Sample(*s, {}) for s in READERS[name].make(Path(made))]
    for path in sorted(folder.rglob(f"*.{name}")) if folder else ():
        if path.stat().st_size < 200_000:
            found.append(Sample(path.name, path.read_bytes(), {}))
    return tuple(found)


# --- cases ------------------------------------------------------------------------------------------------------------


def make_case(name: str, seed: int, number: int, folder: Path | None = None) -> tuple[Sample, bytes]:
    """Return the sample and the broken content of a case."""
    random = np.random.default_rng((seed, number, *name.encode()))
    among = samples(name, folder)
    sample = among[int(random.integers(len(among)))]
    return sample, mutate(sample.raw, READERS[name].container, random)


def run_case(name: str, raw: bytes, beside: Mapping[str, bytes], folder: Path) -> str:
    """Return `read` or `refused`; Broken, or whatever a reader raises that it should not."""
    reader = READERS[name]
    for file, content in {**beside, reader.file: raw}.items():
        (folder / file).write_bytes(content)
    start, peak = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    slowest = SLOWEST_SECONDS * (_PROCESSES if reader.is_isolated else 1)
    try:
        with _time_limit(3 * slowest), warnings.catch_warnings(action="error"), redirect_stderr(io.StringIO()):
            reader.check(folder / reader.file)
        outcome = "read"
    except MapctlError as error:
        message = str(error).replace(str(folder), "")
        require("\n" not in message and len(message) < 600, f"a message of {len(message)} letters: {message[:200]!r}")
        outcome = "refused"
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) // 1024
    require(time.perf_counter() - start < slowest, f"took {time.perf_counter() - start:.1f} s")
    require(grown < MOST_MEGABYTES, f"took {grown} MB")
    return outcome


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise Broken after a while, even if a reader never ends."""

    def stop(*_):
        raise Broken("did not end")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def run_cases(
    name: str, numbers: Sequence[int], seed: int, folder: Path | None = None
) -> tuple[Counter[str], list[str]]:
    """Run cases of a reader; return how many were read and refused, and a line for each failure."""
    tally, failures = Counter[str](), []
    with tempfile.TemporaryDirectory() as scratch, fork_readers(SLOWEST_SECONDS - 1.0):
        for number in numbers:
            sample, raw = make_case(name, seed, number, folder)
            try:
                tally[run_case(name, raw, sample.beside, Path(scratch))] += 1
            except Exception as error:
                reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
                failures.append(f"{name} --seed {seed} --only {number} ({sample.name}): {reason}")
    return tally, failures


def main(argv: Sequence[str] | None = None) -> int:
    """Run cases and print what was found; 1 if anything was."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("readers", nargs="*", help=f"of {', '.join(READERS)}; all if none is named")
    parser.add_argument("--cases", type=int, default=2000, help="of each reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="real files to break too")
    parser.add_argument("--only", type=int, help="one case of the seed")
    parser.add_argument("--keep", type=Path, help="file for the content of that case")
    options = parser.parse_args(argv)
    failed = 0
    for name in options.readers or READERS:
        numbers = range(options.cases) if options.only is None else [options.only]
        start = time.perf_counter()
        tally, failures = run_cases(name, numbers, options.seed, options.folder)
        if options.keep:
            options.keep.write_bytes(make_case(name, options.seed, options.only or 0, options.folder)[1])
        failed += len(failures)
        found = f"{tally['read']} read, {tally['refused']} refused, {len(failures)} failed"
        print(*failures, f"{name}: {found} in {time.perf_counter() - start:.0f} s", sep="\n", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
