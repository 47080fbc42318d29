"""In-betweening beside interpolation: joint errors in gaps of 15, 30 and 45 frames of clips on their own rig.

`--model` is an in-betweener; its bare proposal, without the MAP stage, has a row of its own. `--peer` is a second one,
as a transformer that was trained as in the papers. Ten frames are known before a gap and one after it (at 30 fps), as
in LaFAN1's protocol. `--lafan` prints that protocol's measures instead (Harvey et al. 2020, section 5: L2P, L2Q, NPSS;
gaps of 5, 15, 30 and 45 frames; windows of 65 frames, 40 apart), pooled over the windows of a folder; L2P is in units
of the standard deviation of these windows, not of LaFAN1's training set. `--windows` limits the windows of a clip.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from common import Circle, compare_methods, load_circles, measure_error, parse, print_table
from jaxtyping import Float
from torch import Tensor

import controllers
import priors
from mapctl import rotations
from mapctl.errors import MapctlError
from mapctl.joint_roles import find_hips, find_upper_legs
from mapctl.metrics.body import facing
from mapctl.motion import Motion
from mapctl.recording.masks import ALL, Mask

PAST, WINDOW, STRIDE = 10, 65, 40  # frames at 30 fps
Method = Callable[[Motion, int, int], Motion]  # fills frames start to stop, whose values it does not read


def interpolate(motion: Motion, start: int, stop: int) -> Motion:
    """Fill with slerp and straight lines between the frames beside the gap."""
    share = torch.arange(1, stop - start + 1, dtype=torch.float64) / (stop - start + 1)
    return _blend(motion, start, stop, share, lambda a, b: torch.lerp(a, b, share[:, None]))


def interpolate_smoothly(motion: Motion, start: int, stop: int) -> Motion:
    """Fill with slerp whose share eases in and out, and cubic Hermite curves of the root; its velocity after the gap,
    of which one frame is known, is that of the straight line."""
    frames = stop - start + 1
    share = torch.arange(1, frames, dtype=torch.float64) / frames
    eased = share.square() * (3 - 2 * share)
    row = share[:, None]

    def hermite(first: Tensor, last: Tensor) -> Tensor:
        before = frames * (first - motion.root_position[start - 2]) if start > 1 else last - first
        after = last - first
        return (
            (1 + 2 * row) * (1 - row).square() * first
            + row * (1 - row).square() * before
            + row.square() * (3 - 2 * row) * last
            + row.square() * (row - 1) * after
        )

    return _blend(motion, start, stop, eased, hermite)


def _blend(motion: Motion, start: int, stop: int, share: Tensor, root: Callable[[Tensor, Tensor], Tensor]) -> Motion:
    quats, position = motion.local_quat_xyzw.clone(), motion.root_position.clone()
    ends = (quats[each : each + 1].expand(stop - start, -1, -1) for each in (start - 1, stop))
    quats[start:stop] = rotations.slerp(*ends, share[:, None].expand(-1, motion.num_joints))
    position[start:stop] = root(position[start - 1], position[stop])
    moving = {joint: values.clone() for joint, values in motion.moving_offsets.items()}
    for values in moving.values():
        values[start:stop] = torch.lerp(values[start - 1], values[stop], share[:, None])
    return replace(motion, local_quat_xyzw=quats, root_position=position, moving_offsets=moving)


def list_methods(model: str, peer: str) -> dict[str, Method]:
    """List methods by name."""

    def by(name: str, refine: bool) -> Method:
        inbetweener = priors.load_inbetweener(name)
        refinement = controllers.INFILL_REFINEMENT if refine else None
        return lambda motion, start, stop: (
            controllers.infill(motion, inbetweener, [Mask(ALL, start, stop)], refinement=refinement).motion
        )

    methods: dict[str, Method] = {"slerp": interpolate, "slerp, Hermite": interpolate_smoothly}
    methods |= {f"{peer}, bare": by(peer, False)} if peer else {}
    return methods | {f"{model}, bare": by(model, False), "mapctl infill": by(model, True)}


def cut_windows(motion: Motion, most: int) -> list[Motion]:
    """Cut windows of LaFAN1's protocol, at most so many, evenly spaced."""
    window, stride = (round(each * float(motion.fps) / 30) for each in (WINDOW, STRIDE))
    starts = list(range(0, motion.num_frames - window + 1, stride))
    return [motion.slice(start, start + window) for start in starts[:: max(1, -(-len(starts) // most))]]


def fill(window: Motion, frames: int, method: Method) -> tuple[Motion, Motion, slice]:
    """Fill a gap of so many frames at 30 fps: returns what was shown, what was made, and the frames of the gap."""
    past, gap = (round(each * float(window.fps) / 30) for each in (PAST, frames))
    shown = window.slice(0, past + gap + 1)
    return shown, method(shown, past, past + gap), slice(past, past + gap)


def measure_lafan(circles: list[Circle], methods: Mapping[str, Method], most: int) -> list[dict[str, object]]:
    """Measure L2P, L2Q and NPSS, a row for each folder, length and method; the worst window is that of the joints."""
    rows = []
    for circle in circles:
        for frames in (5, 15, 30, 45):
            filled: dict[str, list[tuple[Tensor, Tensor, float, str]]] = {}
            for clip in circle.clips:
                for window in cut_windows(clip.motion, most):
                    try:
                        done = {name: fill(window, frames, method) for name, method in methods.items()}
                    except MapctlError:
                        circle.skipped += 1
                        break
                    shown, _, gap = next(iter(done.values()))
                    done = {"truth": (shown, shown, gap), **done}
                    for name, (_, result, _) in done.items():
                        positions, quats = see_from_past(result, shown)
                        each = positions[gap], quats[gap], measure_error(shown, result, gap), clip.name
                        filled.setdefault(name, []).append(each)
            if not filled:
                continue
            positions, quats = (torch.stack([each[part] for each in filled["truth"]]) for part in (0, 1))
            std = positions.flatten(0, 1).std(dim=0).clamp_min(1e-6)
            for name in methods:
                result, made_quats = (torch.stack([each[part] for each in filled[name]]) for part in (0, 1))
                worst, clip = max((each[2], each[3]) for each in filled[name])
                rows.append(
                    {"clips of": circle.name, "frames": frames, "method": name, "windows": len(result)}
                    | {"L2P": compute_l2p(result, positions, std), "L2Q": compute_l2q(made_quats, quats)}
                    | {"NPSS": compute_npss(made_quats, quats), "worst, cm": worst, "worst clip": clip}
                )
    return rows


def see_from_past(motion: Motion, shown: Motion) -> tuple[Float[Tensor, "frames joints 3"], Tensor]:
    """Return world positions and rotations as seen from where the hips are and face in the last known frame."""
    here, hips = round(PAST * float(shown.fps) / 30) - 1, find_hips(shown.skeleton)
    left, right = (shown.joint_positions()[here, leg] for leg in find_upper_legs(shown.skeleton))
    heading = facing(left[None], right[None])
    origin = shown.joint_positions()[here, hips] * torch.tensor([1.0, 0.0, 1.0])
    positions = rotations.rotate_about_y(motion.joint_positions() - origin, -heading[:, None])
    turn = rotations.from_rotation_vector(torch.tensor([0.0, 1.0, 0.0]).double() * -heading)
    quats = motion.joint_rotations()
    return positions, rotations.multiply(turn.expand_as(quats), quats)


def compute_l2p(result: Tensor, truth: Tensor, std: Float[Tensor, "joints 3"]) -> float:
    """Return the mean length of the error of all coordinates of a frame, in units of their standard deviations."""
    return float(((result - truth) / std).flatten(-2).norm(dim=-1).mean())


def compute_l2q(result: Tensor, truth: Float[Tensor, "windows frames joints 4"]) -> float:
    """Return the mean length of the error of all world quaternions of a frame, whose signs are nearest the truth's."""
    return float((align_signs(result, truth) - truth).flatten(-2).norm(dim=-1).mean())


def compute_npss(result: Tensor, truth: Float[Tensor, "windows frames joints 4"]) -> float:
    """Return the normalised power spectrum similarity of world quaternions (Gopalakrishnan et al. 2019), 0 at best.

    The spectrum is the squared real part of the transform over frames, as in LaFAN1's code; its cumulated shares are
    compared by coordinate, weighted by the truth's power over all windows.
    """
    flips = torch.where((truth[:, 1:] * truth[:, :-1]).sum(dim=-1, keepdim=True) < 0, -1.0, 1.0)
    truth = torch.cat([truth[:, :1], truth[:, 1:] * flips.cumprod(dim=1)], dim=1)
    spectra = [torch.fft.fft(x.flatten(-2).double(), dim=1).real.square() for x in (truth, align_signs(result, truth))]
    power = spectra[0].sum(dim=1)
    shares = [each / each.sum(dim=1, keepdim=True).clamp_min(1e-30) for each in spectra]
    distance = (shares[0].cumsum(dim=1) - shares[1].cumsum(dim=1)).abs().sum(dim=1)
    weight = torch.where(power > 1e-9, power, 0.0)
    return float((distance * weight).sum() / weight.sum())


def align_signs(result: Float[Tensor, "*batch 4"], truth: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the same rotations by the quaternions nearest to the truth's."""
    return torch.where((result * truth).sum(dim=-1, keepdim=True) < 0, -result, result)


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=20, model="transformer", peer="", windows=2, lafan=False)
    circles = load_circles(given, shortest=2.3, longest=20.0, model=given.model)
    methods = list_methods(given.model, given.peer)
    if given.lafan:
        print_table(measure_lafan(circles, methods, given.windows), circles)
        return

    def measure(motion: Motion, generator: torch.Generator) -> dict[str, dict[str, float]]:
        found: dict[str, dict[str, float]] = {}
        windows = cut_windows(motion, given.windows)
        for frames in (15, 30, 45):
            for name, method in methods.items():
                errors = [measure_error(*fill(window, frames, method)) for window in windows]
                found.setdefault(f"{frames} frames", {})[name] = sum(errors) / len(errors)
        return found

    print_table(compare_methods(circles, measure, seed=given.seed, simple="slerp"), circles)


if __name__ == "__main__":
    main()
