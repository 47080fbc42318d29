"""`mapctl denoise`: a noisy capture is denoised, on its own rig."""

import math

import priors
from controllers.denoising.causal import denoise_causal
from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.denoising.result import DenoiseSolution
from mapctl import report
from mapctl.commands.denoise import Denoise, folder
from mapctl.commands.shared import inputs, licensing, results
from mapctl.commands.shared.exit_status import conclude
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.recording.masks import load_masks
from mapctl.skeleton import CANONICAL

_MAX_NAMED = 6
_LOW_SHARE = 0.5  # share of the frames with the proposal as it is below which a joint is named
_LOW_WEIGHT = 0.5  # weight of a density below which a window is listed
_DEFAULT_DELAY = 0.2  # seconds


def run(command: Denoise) -> int:
    """Check everything, denoise, write, report."""
    if command.source.is_dir():
        return folder.run(command, read_settings(command))
    _check(command)
    done = _run_denoising(command)
    licensing.save_motion(done.motion, command.out)
    if command.report is not None:
        report.write_report(results.build_report("denoise", command, done), command.report)
    results.film_comparison(done.capture, done.motion, command.video, rig=done.rig, quiet=command.quiet)
    if not command.quiet:
        _print_summary(command, done)
    return conclude(done.status, strict=command.strict)


def _check(command: Denoise) -> None:
    for name, idle in (("cluster", command.cluster is None), ("again", not command.again), ("jobs", command.jobs == 1)):
        if not idle:
            raise RequestError(f"--{name} is for folders; {command.source} is a file")
    results.check_destinations(command.out, command.video, command.report, given=(command.source,))


def _run_denoising(command: Denoise) -> DenoiseSolution:
    settings, rig = read_settings(command), inputs.read_rig(command.rig, command)
    named_masks = () if command.mask is None else load_masks(command.mask)
    densities = priors.load_choice(command.prior)
    denoiser = priors.load_denoiser(command.denoiser)
    motion, missing_masks, _ = inputs.read_motion_with_gaps(command.source, rig, quiet=command.quiet)
    masks = (*named_masks, *missing_masks)
    with show_progress("denoising", quiet=command.quiet) as progress:
        if command.causal:
            delay = _DEFAULT_DELAY if command.delay is None else command.delay
            return denoise_causal(
                motion, denoiser, masks=masks, settings=settings, delay=delay, rig=rig, progress=progress
            )
        return denoise(
            motion,
            denoiser,
            inbetweener=priors.load_inbetweener(command.inbetweener or "transformer"),
            masks=masks,
            settings=settings,
            densities=densities,
            rig=rig,
            progress=progress,
        )


def read_settings(command: Denoise) -> DenoiseSettings:
    """Read the settings from the options; RequestError for numbers that make no sense."""
    if command.causal and command.prior is not None:
        raise RequestError("--causal has no time for a density; leave --prior out")
    if command.causal and command.inbetweener is not None:
        raise RequestError("--causal leaves what is lost to the denoiser; leave --inbetweener out")
    if command.delay is not None and not command.causal:
        raise RequestError("--delay is how far --causal may look ahead; leave it out, or ask for both")
    return DenoiseSettings(anchor=command.anchor)


def _print_summary(command: Denoise, done: DenoiseSolution) -> None:
    moved, (joint, frame, most) = float(done.correction()[0].mean()), done.find_largest_move()
    print(
        f"{command.out}: {done.motion.num_frames} frames at {float(done.motion.fps):.6g} a second; joints moved by"
        f" {moved:.1f} cm on average, most {joint} in frame {frame}, {most:.1f} cm; {done.frame_ms:.1f} ms a frame"
    )
    for line in (*format_certainty(done), *format_faults(done)):
        print(line)
    for note in (*done.notes, *format_densities(done)):
        print(note)


def format_certainty(done: DenoiseSolution) -> list[str]:
    """Format the expected error of the joints' angles, and how far the model's proposal was used."""
    if not any(fault.kind == "noise" for fault in done.faults):
        return []
    error, used = math.degrees(float(done.error.square().mean().sqrt())), done.proposal_share.mean(dim=0)
    line = f"expected error: {error:.1f} degrees a joint; the model's proposal as it is in {float(used.mean()):.0%}"
    order = used.argsort().tolist()
    rare = [CANONICAL.names[joint] for joint in order if used[joint] < _LOW_SHARE][:_MAX_NAMED]
    return [line + (f", least in {', '.join(rare)}: there the capture corrects it, or is filtered" if rare else "")]


def format_faults(done: DenoiseSolution) -> list[str]:
    """Format the artefacts, a line for each kind."""
    kinds: dict[str, dict[str, list]] = {}
    for fault in done.faults:
        kinds.setdefault(fault.kind, {}).setdefault(fault.joint, []).append(fault)
    lines = []
    for kind, joints in kinds.items():
        worst = sorted(joints, key=lambda name: -max(fault.amount for fault in joints[name]))
        named = []
        for name in worst[:_MAX_NAMED]:
            found = joints[name]
            top = max(found, key=lambda fault: fault.amount)
            amount = f" {top.amount:.1f} {top.unit}" if top.unit else f" {sum(f.stop - f.start for f in found)} frames"
            named.append(f"{name}{amount}" + (f" ({len(found)} times)" if len(found) > 1 else ""))
        rest = len(worst) - len(named)
        lines.append(f"{kind}: {', '.join(named)}" + (f" and {rest} more joints" if rest > 0 else ""))
    return lines


def format_densities(done: DenoiseSolution) -> list[str]:
    """Format which densities counted, the likelihood under each, and where they were out of their depth."""
    if not done.density_intervals:
        return []
    frames = {name: 0 for name in done.density_intervals[0].nats}
    totals = dict.fromkeys(frames, 0.0)
    for part in done.density_intervals:
        frames[part.prior] += part.stop - part.start
        for name, nats in part.nats.items():
            totals[name] += nats * (part.stop - part.start)
    whole = sum(frames.values())
    nats_by_density = ", ".join(
        f"{name} {totals[name] / whole:.0f} nats a frame, used in {frames[name]}" for name in frames
    )
    lines = [f"prior: {nats_by_density} of {whole} frames"]
    low_weights = [part for part in done.density_intervals if part.weight < _LOW_WEIGHT]
    if low_weights:
        intervals = ", ".join(f"{part.start}:{part.stop}" for part in low_weights[:_MAX_NAMED])
        rest = len(low_weights) - _MAX_NAMED
        lines.append(
            f"prior out of its depth, so that it counts for less than half: frames {intervals}"
            + (f" and {rest} more windows" if rest > 0 else "")
        )
    return lines
