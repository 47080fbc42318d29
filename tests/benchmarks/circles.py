"""Jobs beside the simple method on three circles of motion: python tests/benchmarks/circles.py JOB FOLDER ...

JOB is `noise` (5 degrees, 2 cm, 1 % spikes; beside a Butterworth filter whose cut-off is tuned on the truth) or `gaps`
(5, 15 and 30 frames after ten known ones and before one; beside slerp). Each FOLDER is a circle: of a folder of Bandai
Namco or CMU clips those alone count that the bundled model was not trained on. Prints a Markdown row a circle: the mean
share of the simple method's error, the worst clip, and the share of clips that are worse (by 5 % and 1.5 mm).
`--model NAME,NAME` compares models; `--count N` limits the clips of a circle.
"""

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path

import torch
from scipy.signal import butter, filtfilt

sys.path.insert(0, str(Path(__file__).parents[1]))
from corruptions import add_noise

import controllers
import mapctl
import priors
from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.masks import ALL, Mask
from priors import checkpoints

FIRST, FRAMES, CUTOFFS = 1000, 600, (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12)


def list_clips(folder: Path, held_out: list[str], count: int) -> list[Path]:
    """List clips of at least 4 s, spread over the folder; of a training set those that were held out."""
    files = sorted(file for file in folder.rglob("*.bvh"))
    own = [file for file in files if any(str(file).endswith(name) for name in held_out)]
    trained = re.search(r"dataset-[12]_|(^|/)cmu/", "\n".join(map(str, files)))
    files = own if trained else files
    return files[:: max(1, -(-len(files) // count))]


def load_piece(file: Path) -> Motion | None:
    motion = mapctl.load(file)
    if motion.seconds < 4:
        return None
    first = FIRST if motion.num_frames >= FIRST + FRAMES else 0
    return motion.slice(first, min(motion.num_frames, first + FRAMES))


def measure_error(truth: Motion, other: Motion, frames: slice = slice(None)) -> float:
    """Measure the mean distance of joints, cm."""
    return 100 * float((truth.joint_positions() - other.joint_positions())[frames].norm(dim=-1).mean())


def filter_best(truth: Motion, noisy: Motion) -> float:
    """Measure the least error of fourth-order Butterworth filters, forwards and backwards, cm."""
    errors, rate = [measure_error(truth, noisy)], float(truth.fps) / 2
    for hertz in (each for each in CUTOFFS if each < rate):
        taps = butter(4, hertz / rate)

        def smooth(values: torch.Tensor, taps=taps) -> torch.Tensor:
            return torch.from_numpy(filtfilt(*taps, values.numpy(), axis=0).copy())

        quats = torch.nn.functional.normalize(smooth(rotations.make_sign_continuous(noisy.local_quat_xyzw)), dim=-1)
        moving = {joint: smooth(values) for joint, values in noisy.moving_offsets.items()}
        root = smooth(noisy.root_position)
        smoothed = replace(noisy, root_position=root, local_quat_xyzw=quats, moving_offsets=moving)
        errors.append(measure_error(truth, smoothed))
    return min(errors)


def compare_noise(truth: Motion, name: str, generator: torch.Generator) -> dict[str, tuple[float, float]]:
    """Measure errors of denoising and of the best filter."""
    noisy = add_noise(truth, generator, degrees=5.0, centimetres=2.0)
    done = controllers.denoise(noisy, priors.load_denoiser(name), inbetweener=priors.load_inbetweener("transformer"))
    return {"noise": (measure_error(truth, done.motion), filter_best(truth, noisy))}


def compare_gaps(truth: Motion, name: str, generator: torch.Generator) -> dict[str, tuple[float, float]]:
    """Measure errors of in-betweening and of slerp, three windows a length of gap."""
    found = {}
    for gap in (5, 15, 30):
        errors = []
        for start in torch.randint(max(1, truth.num_frames - gap - 11), (3,), generator=generator).tolist():
            window = truth.slice(start, start + gap + 11)
            done = controllers.infill(window, priors.load_inbetweener(name), [Mask(ALL, 10, 10 + gap)]).motion
            hidden = slice(10, 10 + gap)
            errors.append([measure_error(window, each, hidden) for each in (done, interpolate(window, gap))])
        found[f"{gap} frames"] = tuple(torch.tensor(errors).mean(dim=0).tolist())
    return found


def interpolate(window: Motion, gap: int) -> Motion:
    """Interpolate frames 10 to 10 + gap: slerp and straight lines."""
    share = (torch.arange(1, gap + 1, dtype=torch.float64) / (gap + 1))[:, None]
    quats, root = window.local_quat_xyzw.clone(), window.root_position.clone()
    ends = (quats[9:10].expand(gap, -1, -1), quats[-1:].expand(gap, -1, -1))
    quats[10:-1] = rotations.slerp(*ends, share.expand(gap, window.num_joints))
    root[10:-1] = torch.lerp(root[9:10], root[-1:], share)
    moving = {joint: values.clone() for joint, values in window.moving_offsets.items()}
    for values in moving.values():
        values[10:-1] = torch.lerp(values[9:10], values[-1:], share)
    return replace(window, local_quat_xyzw=quats, root_position=root, moving_offsets=moving)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=("noise", "gaps"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--model", default="")
    parser.add_argument("--count", type=int, default=30)
    given = parser.parse_args()
    usual, compare = {"noise": ("denoiser", compare_noise), "gaps": ("transformer", compare_gaps)}[given.job]
    card = checkpoints.read_card(checkpoints.locate(usual).with_suffix(".json"))
    held_out = [name for names in card.data["held_out"].values() for name in names]
    print("| circle | model | case | clips | mean share | worst clip | clips worse |\n|---|---|---|---|---|---|---|")
    for folder in given.folders:
        files = list_clips(folder, held_out, given.count)
        for name in (given.model or usual).split(","):
            rows: dict[str, list[tuple[float, float, str]]] = {}
            for number, file in enumerate(files):
                truth = load_piece(file)
                if truth is not None:
                    for case, errors in compare(truth, name, torch.Generator().manual_seed(number)).items():
                        rows.setdefault(case, []).append((*errors, file.stem))
            for case, found in rows.items():
                shares = [(ours / max(simple, 0.3), stem) for ours, simple, stem in found]
                worse = sum(ours > 1.05 * simple + 0.15 for ours, simple, _ in found) / len(found)
                mean, worst = sum(share for share, _ in shares) / len(shares), max(shares)
                print(
                    f"| {folder.name} | {Path(name).name} | {case} | {len(found)} | {mean:.2f} |"
                    f" {worst[1]} {worst[0]:.2f} | {worse:.0%} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
