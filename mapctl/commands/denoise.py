"""`mapctl denoise`: a noisy capture is denoised, on its own rig."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from tyro.conf import Positional, arg

import priors
from controllers.denoising.causal import denoise_causal
from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.denoising.solution import DenoiseSolution
from mapctl import formats, report
from mapctl.commands.shared import folders, inputs, options, outputs, results
from mapctl.commands.shared.command import ModelCommand, conclude
from mapctl.commands.shared.outputs import show_progress
from mapctl.errors import RequestError
from mapctl.motion import Motion, join_licences
from mapctl.protocols import Denoiser, Inbetweener
from mapctl.recording.masks import load_masks, masks_from_missing
from mapctl.retarget.rigs import Rig
from mapctl.runtime.file_jobs import FileJob, FileResult, run_over_cluster, run_over_processes, try_job
from mapctl.skeleton import CANONICAL
from priors import weight_sets


@dataclass(frozen=True)
class FileDenoiser:
    """Denoiser of single files, cheap to send to a process, which loads the network on first use."""

    load: Callable[[], Denoiser]
    """Loader of the network: `functools.partial(priors.load_denoiser, "denoiser")`."""
    settings: DenoiseSettings
    """Settings for all files."""
    load_inbetweener: Callable[[], Inbetweener] | None = None
    """Loader of the network that fills what is lost for longer; None leaves that to the denoiser."""
    rig: Rig | None = None
    """Rig of all files, where it is not the one that would be recognised."""
    after: Callable[[FileJob, DenoiseSolution], None] | None = None
    """Function called with each result, in that process: to write a report."""
    licence: str = ""
    """Licence of the results, beside that of each motion; for formats that keep one."""
    on_read: Callable[[Path, Motion, Rig | None], None] | None = None
    """Function called with each file, its motion and its rig, in that process: to print what is doubtful."""

    def __call__(self, job: FileJob) -> FileResult:
        """Denoise one file and write the result; errors are in what is returned, except DiskFullError."""
        torch.set_num_threads(1)
        return try_job(job, self._denoise)

    def _denoise(self, job: FileJob) -> tuple[int, float]:
        unit = None if self.rig is None else self.rig.metres_per_unit
        motion, missing = formats.load_with_missing(job.source, metres_per_unit=unit)
        if self.on_read is not None:
            self.on_read(job.source, motion, self.rig)
        masks = masks_from_missing(motion, missing)
        inbetweener = None if self.load_inbetweener is None else _load_once(self.load_inbetweener)
        denoiser = _load_once(self.load)
        done = denoise(motion, denoiser, inbetweener=inbetweener, masks=masks, settings=self.settings, rig=self.rig)
        done = replace(done, motion=replace(done.motion, licence=motion.licence))
        job.out.parent.mkdir(parents=True, exist_ok=True)
        if self.after is not None:
            self.after(job, done)
        licence = join_licences((self.licence, motion.licence))
        formats.save(replace(done.motion, licence=licence), job.out)
        return done.motion.num_frames, done.seconds


_Network = TypeVar("_Network", Denoiser, Inbetweener)
_LOADED: dict[str, Any] = {}  # the denoiser and the in-betweener that this process loaded last


def _load_once(load: Callable[[], _Network]) -> _Network:
    key = repr(load)
    if key not in _LOADED:
        if len(_LOADED) > 1:
            _LOADED.clear()
        _LOADED[key] = load()
    return _LOADED[key]


@dataclass(frozen=True)
class Denoise(ModelCommand, options.RigOptions):
    """Denoise a capture with noise, sliding and gaps, of any known rig: same skeleton, names, frames and rate."""

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """A motion file, or `example:noisy-walk`, which mapctl brings along; or a folder, every motion below it."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT|FOLDER")]
    """Where the clean motion goes; of a folder, another one, which gets the same names."""
    mask: options.MaybeFile = None
    """CSV with the columns joint, start, stop: frames (from 0, stop exclusive) in which a joint of the rig is missing.
    `*` is everything, `root position` the body's position. What is nan in IN is missing too."""
    anchor: bool = False
    """Correct the trajectory so that planted feet do not travel, for captures in which the body drifts against them."""
    causal: bool = False
    """Denoise as for live capture: a frame is decided at most `--delay` after it arrives."""
    delay: options.MaybeNumber = None
    """Seconds within which --causal decides a frame, at any frame rate, but for the compute; 0.2 if not given."""
    denoiser: options.Name = "denoiser"
    """The bundled denoiser, or the file or run folder of a trained one."""
    inbetweener: options.MaybeName = None
    """The file or run folder of a trained transformer or infiller, for what is lost for 0.3 s or longer; the bundled
    transformer if not given. --causal leaves that to the denoiser."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the last stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. None if not given, which measures as well."""
    report: options.MaybeFile = None
    """JSON with the faults found, corrections, contacts, ledger; of a folder, a folder of them."""
    video: options.MaybeFile = None
    """Film of the capture and the result side by side: .mp4, .gif, .webp or .png."""
    jobs: options.Count = 1
    """For a folder: number of files at once, each in a process of its own."""
    cluster: Annotated[str | None, arg(metavar="local|ADDRESS")] = None
    """For a folder: use a ray cluster instead; `local` starts one on this machine with --jobs workers."""
    again: bool = False
    """For a folder: denoise files again whose result exists already."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: the network was out of its depth for more than half of
    the frames."""
    quiet: bool = False
    """No summary and no progress bar."""


_MAX_NAMED = 6
_LOW_SHARE = 0.5  # share of the frames with the proposal as it is below which a joint is named
_LOW_WEIGHT = 0.5  # weight of a density below which a window is listed
_DEFAULT_DELAY = 0.2  # seconds


def run(command: Denoise) -> int:
    """Check everything, denoise, write, report."""
    if command.source.is_dir():
        return run_folder(command, read_settings(command))
    _check(command)
    done = _run_denoising(command)
    outputs.save_motion(done.motion, command.out)
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


def run_folder(command: Denoise, settings: DenoiseSettings) -> int:
    """Check, denoise what is not done yet, list what failed."""
    jobs, skipped = collect_jobs(command)
    priors.load_denoiser(command.denoiser)  # a typing error is reported once, now
    load = partial(priors.load_denoiser, priors.add_set(command.denoiser))
    load_inbetweener = partial(priors.load_inbetweener, priors.add_set(command.inbetweener or "transformer"))
    load_inbetweener()
    used = dict(weight_sets.find_used_licences())  # what the processes use, and they do not record
    after = None if command.report is None else ReportWriter(command, command.report, used)
    licence = outputs.format_used_licences()
    rig, on_read = inputs.read_rig(command.rig, command), None if command.quiet else inputs.print_doubts
    file_denoiser = FileDenoiser(load, settings, load_inbetweener, rig, after, licence, on_read)
    if command.cluster is not None:
        ended = run_over_cluster(jobs, file_denoiser, address=command.cluster, workers=command.jobs)
    else:
        ended = run_over_processes(jobs, file_denoiser, processes=command.jobs)
    found = folders.await_results(ended, len(jobs), label="denoising", again=command.again, quiet=command.quiet)
    return folders.conclude(command.out, found, skipped, done="denoised", quiet=command.quiet)


def collect_jobs(command: Denoise) -> tuple[list[FileJob], int]:
    """Collect the jobs, and the number of files done already; RequestError for options that folders do not take."""
    for name in ("mask", "video", "prior", "causal", "strict"):
        if getattr(command, name):
            raise RequestError(f"--{name} is for single files; {command.source} is a folder")
    if command.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {command.jobs}")
    if command.cluster not in (None, "local") and command.jobs != 1:
        raise RequestError(f"--jobs is for this machine; the cluster at {command.cluster} has workers of its own")
    if command.report is not None:
        outputs.check_folder(command.report)
    return folders.collect_jobs(command.source, command.out, again=command.again)


@dataclass(frozen=True)
class ReportWriter:
    """Writer of a report for each file, in the process that denoised it."""

    command: Denoise
    """The command."""
    folder: Path
    """Folder of the reports, named as the results."""
    used: dict[str, str]
    """Licences of the models; that of the motion joins them."""

    def __call__(self, job: FileJob, done: DenoiseSolution) -> None:
        """Write one report."""
        path = (self.folder / job.out.relative_to(self.command.out)).with_suffix(".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        own = done.motion.licence
        used = self.used | ({str(job.source): weight_sets.shorten_licence(own)} if own else {})
        told = results.build_report("denoise", self.command, done)
        report.write_report(told | weight_sets.describe_licences(used), path)
