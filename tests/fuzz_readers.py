"""Every reader on broken files: a MapctlError, or what the file says; never worse, never slow, never large.

    python tests/fuzz_readers.py --cases 10000 --seed 1 FOLDER...

mutates the .bvh, .npz and .amc files below the folders (cut to a few frames), and small files of the other kinds. A
case is told by its seed and number alone, so that a failure can be run again: --seed S --only N.
"""

import argparse
import io
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from acclaim import pair
from character_maker import make_character_glb
from fbx_binary import to_binary
from fbx_maker import make_fbx
from forged_characters import forge_glb
from forked_readers import fork_readers
from fuzz_checks import ISOLATED, READERS, Broken, require
from mutations import mutated
from usd_specimens import make_usd_specimens

from mapctl import formats
from mapctl.errors import MapctlError

SLOWEST_SECONDS, MOST_MEGABYTES = 4.0, 600
"""Bounds on one case: its time, and what it adds to the peak of memory."""
_PROCESSES = 5  # that read one file of some kinds, one after the other: clip, mesh, rest pose, written, again


@dataclass(frozen=True)
class Specimen:
    """A sound file, to be mutated."""

    name: str
    kind: str
    """Key of `READERS`."""
    raw: bytes
    beside: bytes = b""
    """The other half of an ASF and AMC pair."""


# --- cases ------------------------------------------------------------------------------------------------------------


def run_case(specimen: Specimen, raw: bytes, folder: Path) -> str:
    """`read` or `refused`; Broken, or whatever a reader raises that it should not."""
    name, check = READERS[specimen.kind]
    path = folder / name
    other = path.with_suffix(".asf")
    other.unlink(missing_ok=True)
    if specimen.kind == "asf":
        other.write_bytes(raw)
        path.write_bytes(specimen.beside)
    else:
        path.write_bytes(raw)
        if specimen.beside:
            other.write_bytes(specimen.beside)
    start, peak = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    slowest = SLOWEST_SECONDS * (_PROCESSES if specimen.kind in ISOLATED else 1)
    try:
        with time_limit(3 * slowest), warnings.catch_warnings(action="error"):
            check(path)
        outcome = "read"
    except MapctlError as error:
        told = str(error).replace(str(folder), "")
        require("\n" not in told and len(told) < 600, f"a message of {len(told)} letters: {told[:200]!r}")
        outcome = "refused"
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) // 1024
    require(time.perf_counter() - start < slowest, f"took {time.perf_counter() - start:.1f} s")
    require(grown < MOST_MEGABYTES, f"took {grown} MB")
    return outcome


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Broken after a while, even if a reader never ends."""

    def stop(*_):
        raise Broken("did not end")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def case(specimens: Sequence[Specimen], seed: int, number: int) -> tuple[Specimen, bytes]:
    """What case `number` of a seed reads. Kinds take turns, so that one with many specimens hides no other."""
    random = np.random.default_rng((seed, number))
    kinds = sorted({specimen.kind for specimen in specimens})
    kind = kinds[number % len(kinds)]
    among = [specimen for specimen in specimens if specimen.kind == kind]
    specimen = among[int(random.integers(len(among)))]
    if specimen.kind == "npz" and random.random() < 0.7:
        return specimen, _forged(specimen.raw, random)
    if specimen.kind == "glb" and random.random() < 0.7:
        return specimen, forge_glb(specimen.raw, random)
    if specimen.kind in ("usdc", "fbx") and random.random() < 0.5:
        return specimen, _with_bytes(specimen.raw, random)
    return specimen, mutated(specimen.raw, random)


def _with_bytes(raw: bytes, random: np.random.Generator) -> bytes:
    """A few bytes replaced, so that most of the file is still read."""
    changed = bytearray(raw)
    for _ in range(int(random.integers(1, 6))):
        changed[int(random.integers(len(raw)))] = int(random.choice((0, 1, 127, 128, 255, random.integers(256))))
    return bytes(changed)


def _forged(raw: bytes, random: np.random.Generator) -> bytes:
    """A sound archive with an array that is not."""
    with np.load(io.BytesIO(raw), allow_pickle=False) as held:
        arrays = dict(held)
    key = sorted(arrays)[int(random.integers(len(arrays)))]
    old = arrays[key]
    odd = (np.nan, np.inf, 1e308, -1e308, 0.0, 1e9, -1.0, 2.0**63)
    changes: tuple[Callable[[], np.ndarray | None], ...] = (
        lambda: None,
        lambda: old[..., None],
        lambda: old.reshape(-1),
        lambda: old[:0] if old.ndim else old,
        lambda: np.concatenate([old, old]) if old.ndim else old,
        lambda: old.astype(np.complex128, casting="unsafe"),
        lambda: old.astype(np.float16),
        lambda: old.astype(object),
        lambda: np.array("x" * 500),
        lambda: np.zeros((2**20, 3)),
        lambda: np.array(7),
        lambda: old.astype(">f8"),
        lambda: np.flip(old),
        lambda: _with(old, odd[int(random.integers(len(odd)))], random),
        lambda: _with(old, odd[int(random.integers(len(odd)))], random),
    )
    try:
        new = changes[int(random.integers(len(changes)))]()
    except (ValueError, TypeError):  # as text to numbers
        new = None
    if new is None:
        del arrays[key]
    else:
        arrays[key] = new
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _with(old: np.ndarray, value: float, random: np.random.Generator) -> np.ndarray:
    """One element replaced; a name by another's."""
    changed = old.copy().reshape(-1)
    if len(changed):
        filler = changed[int(random.integers(len(changed)))] if old.dtype.kind == "U" else value
        with np.errstate(all="ignore"):
            changed[int(random.integers(len(changed)))] = np.array(filler).astype(old.dtype)
    return changed.reshape(old.shape)


def specimens(folders: Sequence[Path] = (), most: int = 200) -> list[Specimen]:
    """Small sound files of every kind: those made here, and up to `most` real ones below the folders."""
    found = list(_made())
    for folder in folders:
        paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".bvh", ".npz", ".amc", ".csv", ".svg"))
        for path in paths[:: max(1, len(paths) // most)]:
            found += _real(path)
    return found


def _real(path: Path) -> Iterator[Specimen]:
    """A real file, its motion cut to a few frames. Tables are left out: nothing says what they are for."""
    ending = path.suffix.lower()
    if ending == ".bvh":
        yield Specimen(path.name, "bvh", _cut_bvh(path.read_bytes()))
    elif ending == ".npz":
        yield Specimen(path.name, "npz", path.read_bytes())
    elif ending == ".amc":
        from mapctl.formats.acclaim import find_paths

        asf, lines = find_paths(path)[0].read_bytes(), path.read_bytes().splitlines(keepends=True)
        fourth = next((k for k, line in enumerate(lines) if line.split() == [b"4"]), len(lines))
        yield Specimen(path.name, "amc", b"".join(lines[:fourth]), asf)
        yield Specimen(path.name, "asf", asf, b"".join(lines[:fourth]))


def _cut_bvh(raw: bytes, frames: int = 3) -> bytes:
    """The head and the first rows, with `Frames` as many as there are then."""
    head, time_line, rows = re.split(rb"(?i)(frame\s*time.*\n)", raw, maxsplit=1)
    kept = [row for row in rows.split(b"\n") if row.strip()][:frames]
    head = re.sub(rb"(?i)(frames\s*:?\s*)\d+", lambda found: found[1] + str(len(kept)).encode(), head)
    return head + time_line + b"\n".join(kept) + b"\n"


def _made() -> Iterator[Specimen]:
    """Files of every kind that need no data set."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed in range(3):
            told = pair(3, seed=seed, degrees=seed != 1, missing=0.3 * (seed == 2))
            asf, amc = told.asf().encode(), told.amc().encode()
            yield Specimen(f"made-{seed}.amc", "amc", amc, asf)
            yield Specimen(f"made-{seed}.asf", "asf", asf, amc)
            motion = formats.load(told.write(folder))
            for ending in ("bvh", "npz"):
                motion.save(folder / f"x.{ending}")
                yield Specimen(f"made-{seed}.{ending}", ending, (folder / f"x.{ending}").read_bytes())
        for number, look in enumerate(_CHARACTERS):
            made = make_character_glb(folder / "x.glb", **look, frames=5)
            yield Specimen(f"made-{number}.glb", "glb", made.path.read_bytes())
        if find_spec("ufbx"):
            for number, look in enumerate(_FBX):
                make_fbx(folder / "x.fbx", **look, frames=3)
                raw = (folder / "x.fbx").read_bytes()
                yield Specimen(f"made-{number}.fbx", "fbx", raw)
                yield Specimen(f"made-{number}-binary.fbx", "fbx", to_binary(raw.decode()))
        for name, raw in make_usd_specimens(folder):
            yield Specimen(name, name.rpartition(".")[2], raw)
    for number, (kind, text) in enumerate(_TABLES):
        yield Specimen(f"made-{number}.{kind}", kind, text.encode())


_CHARACTERS: tuple[dict[str, Any], ...] = (
    {"animations": ("walk",)},
    {
        "names": "vrm",
        "pose": "A",
        "second_skin": True,
        "hat": True,
        "interpolation": "CUBICSPLINE",
        "animations": ("a",),
    },
    {"names": "vrm0", "compact": True, "morphs": 1},
    {"matrices": True, "node_pose": "bent", "root": "root"},
)
_FBX: tuple[dict[str, Any], ...] = (
    {"skin": False},
    {"z_up": True, "parts": ("shoes",)},
    {"takes": ("a", "b"), "parts": ("shoes",), "scale": (2.0, 2.0, 2.0)},
)
_TABLES = (
    ("commands", "time_s,speed_mps,heading_deg\n0,1.2,0\n2,0.5,90\n4.5,0,-90\n"),
    (
        "commands",
        "time_s,speed_mps,heading_deg,facing_deg,turn_deg_s,step_m,gait,style\n"
        "0,1,0,,,,walk,\n1,1,10,5,,0.6,,old\n3,2,20,,15,,run,\n",
    ),
    ("curve", "x,z\n0,0\n1,0.5\n2,0.25\n3,1\n"),
    ("curve", "# drawn by hand\nz;y;x\n0,5;0;1\n1;0;2,5\n"),
    ("curve", "0 0\n1 1\n2 4\n3 9\n"),
    ("curve", "0\t0\t0\n1\t0\t1\n2\t0\t4\n"),
    ("masks", "joint,start,stop\nhips,0,10\nleftFoot,20,25\n*,40,50\n"),
    ("masks", "start,stop,joint\n3,9,root position\n10,12,head\n"),
    ("svg", '<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0 L100 0 C150 0 200 50 200 100 Z"/></svg>'),
    ("svg", '<svg><g transform="translate(10 20) rotate(30)"><path d="M0,0 Q50,50 100,0 T200,0"/></g></svg>'),
    ("svg", '<svg><polyline points="0,0 10,10 20,0"/></svg>'),
    ("svg", '<svg><circle cx="0" cy="0" r="200" transform="scale(2)"/></svg>'),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run cases and tell what was found; 1 if anything was."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path, help="real files to mutate")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", help="kinds of files; all unless told otherwise")
    parser.add_argument("--only", type=int, help="one case of the seed")
    parser.add_argument("--keep", type=Path, help="folder for the files that were found")
    words = parser.parse_args(argv)
    samples = [s for s in specimens(words.folders) if words.kinds is None or s.kind in words.kinds]
    tally, failed, start = Counter(), 0, time.perf_counter()
    numbers = range(words.cases) if words.only is None else [words.only]
    with tempfile.TemporaryDirectory() as name, fork_readers(SLOWEST_SECONDS - 1.0):
        for number in numbers:
            specimen, raw = case(samples, words.seed, number)
            try:
                tally[specimen.kind, run_case(specimen, raw, Path(name))] += 1
            except Exception as error:
                failed += 1
                print(f"case {number} ({specimen.name}): {type(error).__name__}: {str(error)[:300]}", flush=True)
                if words.keep:
                    (words.keep / f"{words.seed}-{number}.{specimen.kind}").write_bytes(raw)
    seconds = time.perf_counter() - start
    for kind in READERS:
        print(f"{kind:9} {tally[kind, 'read']:6} read {tally[kind, 'refused']:6} refused")
    print(f"{len(numbers)} cases of {len(samples)} files in {seconds:.0f} s, {failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
