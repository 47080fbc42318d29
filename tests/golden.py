"""Golden outputs: every command on small priors with fixed seeds, and fingerprints of all that it writes and prints.

`python tests/golden.py` compares this checkout's outputs with tests/golden.json; with `--write` it writes that file
anew, which a commit that means to change what the program does explains. Bits hold on the kind of machine that wrote
the file (processor and libraries, see `kind_of_machine`); elsewhere the numbers in each file are compared, within a
tolerance.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import re
import sys
import tempfile
from pathlib import Path

import llvmlite.binding
import numba
import numpy
import torch
from helpers import run, walk, write_corpus
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller
from tiny_prior import save_tiny_prior
from tiny_transformer import save_tiny_transformer

FILE = Path(__file__).with_name("golden.json")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")
_TIMED = {"timing", "seconds", "frame_ms", "versions"}
_SHOWN = 6  # numbers of each file that are kept

KEYS = """fps = 30
body = "walk.bvh"
[[key]]
frame = 0
[[key]]
frame = 12
reach = { leftHand = [0.45, 1.2, 0.7] }
[[key]]
frame = 24
pose_frame = 30
place = [0.1, 1.0]
"""
SCENE = """title = "two"
prior = "tiny.safetensors"
outputs = ["scene.bvh", "scene.json"]
[[actors]]
name = "one"
curve = "line:1"
seconds = 1
[[actors]]
name = "two"
curve = "circle:2"
seconds = 1.2
speed = 0.9
offset = [2, 0]
"""
STEERING = "time_s,speed_mps,heading_deg\n0,1.2,0\n0.4,0.9,60\n1,1,0\n"

COMMANDS = {
    "follow": "follow wave:0.5x2 -o follow.bvh --prior tiny.safetensors --seconds 1.5 --report follow.json",
    "follow on a rig": "follow line:2 -o rigged.npz --prior tiny.safetensors --seconds 1 --speed 0:1,1:1.4"
    " --rig walk.bvh --seed 3",
    "generate": "generate -o drawn --prior tiny.safetensors --seconds 1.5 --count 2 --seed 4",
    "generate on": "generate -o on --prior tiny.safetensors --seconds 1 --start walk.bvh --temperature 0.5"
    " --no-footing",
    "run": "run scene.toml -o scene --quiet",
    "steer": "steer steering.csv -o steered.bvh --prior tiny.safetensors --report steered.json",
    "denoise": "denoise noisy.bvh -o clean.bvh --denoiser denoiser.safetensors --report clean.json",
    "denoise with a prior": "denoise noisy.bvh -o clean-2.bvh --denoiser denoiser.safetensors --prior tiny.safetensors"
    " --mask mask.csv --capture video",
    "denoise causal": "denoise noisy.bvh -o causal.bvh --denoiser denoiser.safetensors --causal",
    "infill": "infill walk.bvh -o filled.bvh --gap 10:22 --inbetweener transformer.safetensors --report filled.json",
    "infill joints": "infill walk.bvh -o arm.bvh --gap 5:25 --joints leftLowerArm,leftHand"
    " --inbetweener transformer.safetensors --prior tiny.safetensors",
    "infill along a curve": "infill walk.bvh -o led.bvh --gap 10:30 --curve line:2"
    " --inbetweener transformer.safetensors",
    "infill by lines": "infill walk.bvh -o lines.bvh --gap 10:22 --method slerp --no-refine",
    "infill by rollouts": "infill walk.bvh -o rolled.bvh --gap 10:22 --method rollouts"
    " --inbetweener transformer.safetensors --prior tiny.safetensors --seed 2",
    "tween": "tween walk.bvh -o tweened.bvh --keyframes 0,14,29 --inbetweener transformer.safetensors"
    " --report tweened.json",
    "tween file": "tween keys.toml -o keyed.bvh --inbetweener transformer.safetensors --prior tiny.safetensors",
    "tween timing": "tween walk.bvh -o timed.bvh --keyframes 0,14,29 --inbetweener infiller.safetensors"
    " --suggest-timing --method infiller --no-refine",
    "tween variations": "tween walk.bvh -o several.bvh --keyframes 0,12 --inbetweener transformer.safetensors"
    " --prior tiny.safetensors --variations 2",
    "tween slerp": "tween walk.bvh -o slerped.bvh --keyframes 0,14,29 --method slerp --no-refine",
    "blend": "blend walk.bvh --from other.bvh --joints leftHand --frames 5:15 --at 12 -o blended.bvh"
    " --inbetweener transformer.safetensors",
    "chain": "chain walk.bvh other.bvh -o chained.bvh --piece 12 --gap 6:8 --inbetweener transformer.safetensors",
    "convert": "convert walk.bvh canonical.npz --rig canonical",
    "convert rate": "convert walk.bvh slower.glb --fps 24",
    "measure": "measure follow.bvh --curve wave:0.5x2 --reference walk.bvh --json",
    "info clip": "info walk.bvh --json",
    "train lstm-gmm": "train lstm-gmm --data data -o lstm --steps 3 --batch 4 --window 20 --width 8 --seed 2",
    "train denoiser": "train denoiser --data data -o denoiser --steps 2 --batch 2 --window 32 --seed 2",
    "train infiller": "train infiller --data data -o infiller --steps 2 --batch 2 --window 32 --seed 2",
    "train lstm-gmm, paper": "train lstm-gmm --data data -o paper --steps 2 --batch 2 --window 20 --width 8 --seed 2"
    " --paper",
}
"""By name, a command line that is run in the folder `prepare` makes, one after the other."""


def prepare(folder: Path) -> None:
    """Small models and inputs."""
    save_tiny_prior(folder / "tiny.safetensors")
    save_tiny_infiller(folder / "infiller.safetensors", drawn=0.02)
    save_tiny_transformer(folder / "transformer.safetensors", drawn=0.02)
    save_tiny_denoiser(folder / "denoiser.safetensors", drawn=0.02)
    write_corpus(folder / "data", count=4, frames=160)
    from captures import noisy, on_rig

    walker = on_rig("bandai", 40)
    walker.save(folder / "walk.bvh")
    on_rig("cmu", 40).save(folder / "other.bvh")
    noisy(walker).save(folder / "noisy.bvh")
    walk(30).save(folder / "canonical.bvh")
    (folder / "keys.toml").write_text(KEYS)
    (folder / "scene.toml").write_text(SCENE)
    (folder / "steering.csv").write_text(STEERING)
    (folder / "mask.csv").write_text("joint,start,stop\nleftHand,5,15\n")


def kind_of_machine() -> str:
    """Describe the machine as far as bits depend on it: processor, instruction sets, libraries, and how these add: two
    processors of one name, whose caches are shared otherwise, may not add in the same order."""
    processor = llvmlite.binding.get_host_cpu_name()
    versions = f"torch {torch.__version__}, numpy {numpy.__version__}, numba {numba.__version__}"
    return f"{processor}, {torch.backends.cpu.get_cpu_capability()}, {versions}, sums {_hash_sums()}"


def _hash_sums() -> str:
    """Hash what the libraries' sums and functions come to, on one thread."""
    generator, threads = torch.Generator().manual_seed(0), torch.get_num_threads()
    torch.set_num_threads(1)
    bits = hashlib.sha256(llvmlite.binding.get_host_cpu_features().flatten().encode())
    for rows, inner, columns in ((1, 17, 64), (8, 64, 256), (32, 500, 2000), (200, 130, 130), (1000, 3, 3)):
        for kind in (torch.float32, torch.float64):
            one = torch.randn(rows, inner, generator=generator, dtype=kind)
            other = torch.randn(inner, columns, generator=generator, dtype=kind)
            product = one @ other
            for values in (product, product.tanh().exp().sum(dim=0), torch.linalg.svdvals(one), product.numpy().sum()):
                bits.update(numpy.asarray(values).tobytes())
    torch.set_num_threads(threads)
    return bits.hexdigest()[:12]


def run_command(line: str) -> dict[str, dict]:
    """Run a command line in the working directory; return a fingerprint of each file that it writes."""
    known, said = _files(), io.StringIO()
    with contextlib.redirect_stdout(said):
        status = run(*line.split())
    assert status in (0, 3), f"{line}: exit status {status}"
    Path("said.txt").write_text(_without_times(said.getvalue()))
    return {str(path): fingerprint(path) for path in sorted(_files() - known | {Path("said.txt")})}


def _files() -> set[Path]:
    """Without the cache of a data folder, whose names depend on its files' times."""
    return {path for path in Path().rglob("*") if path.is_file() and "cache" not in path.parts}


def fingerprint(path: Path) -> dict:
    """A hash of a file without its times, and of the numbers in it their count, their size, and a few."""
    content = path.read_bytes()
    if path.suffix == ".json":
        content = json.dumps(_timeless(json.loads(content)), sort_keys=True).encode()
    numbers = _numbers(path, content)
    every = max(1, len(numbers) // _SHOWN)
    return {
        "sha256": hashlib.sha256(content).hexdigest()[:24],
        "count": len(numbers),
        "rms": _rounded(math.sqrt(sum(x * x for x in numbers) / max(1, len(numbers)))),
        "some": [_rounded(x) for x in numbers[every // 2 :: every]],
    }


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")


def _numbers(path: Path, content: bytes) -> list[float]:
    if path.suffix == ".npz":
        with numpy.load(path) as found:
            arrays = [found[key] for key in sorted(found) if found[key].dtype.kind == "f"]
        return [float(x) for array in arrays for x in array.ravel()]
    if path.suffix == ".safetensors":
        from safetensors.numpy import load

        tensors = load(content)
        return [float(x) for key in sorted(tensors) for x in tensors[key].astype("f8").ravel()]
    try:
        return [float(text) for text in _NUMBER.findall(content.decode())]
    except UnicodeDecodeError:
        return []


def _timeless(value):
    """JSON without what depends on the clock."""
    if isinstance(value, dict):
        return {key: _timeless(v) for key, v in value.items() if key not in _TIMED}
    return [_timeless(v) for v in value] if isinstance(value, list) else value


def _without_times(text: str) -> str:
    """Printed lines without those that tell a cost or a time."""
    return "\n".join(line for line in text.splitlines() if not re.search(r"\bm?s\b|frames a second|real time", line))


def differences(found: dict[str, dict], golden: dict[str, dict], *, to_the_bit: bool) -> list[str]:
    """List the differences of one command's files, a line each."""
    faults = [f"{name}: not made" for name in golden.keys() - found.keys()]
    faults += [f"{name}: new" for name in found.keys() - golden.keys()]
    for name in sorted(found.keys() & golden.keys()):
        ours, theirs = found[name], golden[name]
        if to_the_bit and ours["sha256"] != theirs["sha256"]:
            faults.append(f"{name}: other bits; numbers {ours['some']}, golden {theirs['some']}")
        elif not to_the_bit and not _near(ours, theirs):
            faults.append(f"{name}: {ours}, golden {theirs}")
    return faults


def _near(ours: dict, theirs: dict) -> bool:
    """Whether the numbers are as near as another processor's arithmetic may leave them."""
    if ours["count"] != theirs["count"]:
        return False
    room = 0.05 * theirs["rms"] + 1e-6
    return all(
        abs(a - b) <= room for a, b in zip([ours["rms"], *ours["some"]], [theirs["rms"], *theirs["some"]], strict=True)
    )


def run_all(commands: dict[str, str], golden: dict, *, to_the_bit: bool) -> tuple[dict, int]:
    """Run commands in the working directory; return their fingerprints and the number of faults, which it prints."""
    all_found, bad = {}, 0
    for name, line in commands.items():
        found = all_found[name] = run_command(line)
        faults = differences(found, golden.get(name, {}), to_the_bit=to_the_bit)
        bad += len(faults)
        print(f"{name}: {len(found)} files, {'; '.join(faults) if faults else 'as they were'}"[:300], flush=True)
    return all_found, bad


def main() -> None:
    """Compare, or write."""
    os.environ["NO_COLOR"] = "1"
    torch.set_num_threads(1)
    golden = json.loads(FILE.read_text()) if FILE.exists() else {"machine": "", "outputs": {}}
    to_the_bit = golden["machine"] == kind_of_machine()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        prepare(Path())
        all_found, bad = run_all(COMMANDS, golden["outputs"], to_the_bit=to_the_bit)
    if "--write" in sys.argv:
        FILE.write_text(json.dumps({"machine": kind_of_machine(), "outputs": all_found}, indent=1) + "\n")
    else:
        sys.exit(bool(bad))


if __name__ == "__main__":
    main()
