"""`mapctl denoise`: a noisy capture is denoised, on its own rig."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, TypeVar

import torch
from tyro.conf import Positional, arg

import priors
from controllers.denoising.causal import denoise_causal
from controllers.denoising.denoise import CaptureKind, DenoiseSettings, denoise
from controllers.denoising.solution import DenoiseSolution
from mapctl.commands.shared import folders, inputs, options, outputs, results
from mapctl.commands.shared.command import ModelCommand, conclude
from mapctl.errors import RequestError
from mapctl.ground import Ground
from mapctl.recording.masks import load_masks
from mapctl.retarget.rigs import Rig
from mapctl.runtime.stepwise import Progress
from mapctl.skeleton import CANONICAL
from priors import checkpoints, weight_sets

T = TypeVar("T")


@dataclass(frozen=True)
class Denoise(ModelCommand, options.RigOptions, options.FolderOptions):
    """Denoise a capture with noise, sliding and gaps, of any known rig: same skeleton, names, frames and rate."""

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """A motion file, or `example:noisy-walk`, which mapctl brings along; or a folder, every motion below it."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT|FOLDER")]
    """Output file; of a folder, another folder, for files of the same names."""
    mask: options.MaybeFile = None
    """CSV with the columns joint, start, stop: frames (from 0, stop exclusive) in which a joint of the rig is missing.
    `*` is everything, `root position` the body's position. What is nan in IN is missing too."""
    markers: options.MaybeMarkers = None
    capture: CaptureKind = "auto"
    """`video`: move the hips so that standing toes neither slide nor leave the floor at y = 0, for estimates from
    video, whose body drifts and floats. `studio`: the trajectory is as good as the pose. `auto`: as video where
    standing toes slide faster than captured ones do, but not under a walk in place. --causal keeps the trajectory."""
    ground: options.MaybeFile = None
    """TOML file of the ground under a capture from video, where it is not the floor at y = 0: ramps and stairs (see
    `mapctl follow --help`)."""
    only_faults: bool = False
    """Repair only the faults that `mapctl measure` lists, but for noise and smoothing: all other frames and joints stay
    to the bit. A foot at fault changes legs and hips from 0.3 s before it to 0.3 s after."""
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
    cluster: Annotated[str | None, arg(metavar="local|ADDRESS")] = None
    """For a folder: use a ray cluster instead; `local` starts one on this machine with --jobs workers."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: the network was out of its depth for more than half of
    the frames, or with --only-faults a fault is left."""

    @property
    def settings(self) -> DenoiseSettings:
        ground = None if self.ground is None else Ground.read(self.ground)
        return DenoiseSettings(capture=self.capture, ground=ground, only_faults=self.only_faults)


_MAX_NAMED = 6
_LOW_SHARE = 0.5  # share of the frames with the proposal as it is below which a joint is named
_LOW_WEIGHT = 0.5  # weight of a density below which a window is listed
_DEFAULT_DELAY = 0.2  # seconds


def run(command: Denoise) -> int:
    if command.causal and command.prior is not None:
        raise RequestError("--causal has no time for a density; leave --prior out")
    if command.causal and command.capture == "video":
        raise RequestError("--capture video finds the floor from the whole capture; leave it or --causal out")
    if command.ground is not None and (command.causal or command.only_faults or command.capture == "studio"):
        raise RequestError("--ground is for the hips of captures from video; leave it out")
    if command.causal and command.only_faults:
        raise RequestError("--only-faults finds faults in the whole capture; leave it or --causal out")
    _ = command.settings  # refuses before models are loaded
    if command.causal and command.inbetweener is not None:
        raise RequestError("--causal leaves what is lost to the denoiser; leave --inbetweener out")
    if command.delay is not None and not command.causal:
        raise RequestError("--delay is how far --causal may look ahead; leave it out, or ask for both")
    if command.source.is_dir():
        return _run_folder(command)
    folders.refuse_options(command, command.source, "cluster")
    results.check_destinations(command.out, command.video, command.report, given=(command.source,))
    rig = inputs.read_rig(command.rig, command)
    with outputs.show_progress("denoising", quiet=command.quiet) as progress:
        done = _denoise_file(command, rig, progress)
    results.write_result("denoise", command, done, done.capture, rig=done.rig)
    if not command.quiet:
        moved, (joint, frame, most) = float(done.correction()[0].mean()), done.find_largest_move()
        print(
            f"{command.out}: {done.motion.num_frames} frames at {float(done.motion.fps):.6g} a second; joints moved by"
            f" {moved:.1f} cm on average, most {joint} in frame {frame}, {most:.1f} cm; {done.frame_ms:.1f} ms a frame"
        )
        print("\n".join([*_format_certainty(done), *_format_faults(done), *done.notes, *_format_densities(done)]))
    return conclude(done.status, strict=command.strict)


def _denoise_file(command: Denoise, rig: Rig | None, progress: Progress | None = None) -> DenoiseSolution:
    named_masks = () if command.mask is None else load_masks(command.mask)
    densities, denoiser = priors.load_choice(command.prior), _load(priors.load_denoiser, command.denoiser)
    motion, missing_masks, _ = inputs.read_motion_with_gaps(
        command.source, rig, markers=command.markers, quiet=command.quiet
    )
    masks = (*named_masks, *missing_masks)
    if command.causal:
        delay = _DEFAULT_DELAY if command.delay is None else command.delay
        return denoise_causal(
            motion, denoiser, masks=masks, settings=command.settings, delay=delay, rig=rig, progress=progress
        )
    return denoise(
        motion,
        denoiser,
        inbetweener=_load(priors.load_inbetweener, command.inbetweener or "transformer"),
        masks=masks,
        settings=command.settings,
        densities=densities,
        rig=rig,
        progress=progress,
    )


def _load(load: Callable[[str], T], name: str) -> T:
    """Load a network, once a process; its licence is noted each time."""
    checkpoints.note_use(name)
    return _load_once(load, name, checkpoints.locate(name).resolve())


_load_once = cache(lambda load, name, _path: load(name))


def _format_certainty(done: DenoiseSolution) -> list[str]:
    """Format the expected error of the joints' angles, and how far the model's proposal was used."""
    if not any(fault.kind == "noise" for fault in done.faults):
        return []
    error, used = math.degrees(float(done.error.square().mean().sqrt())), done.proposal_share.mean(dim=0)
    if done.drift is not None:  # from video the model proposes only what was not observed
        return [f"expected error: {error:.1f} degrees a joint"]
    line = f"expected error: {error:.1f} degrees a joint; the model's proposal as it is in {float(used.mean()):.0%}"
    order = used.argsort().tolist()
    rare = [CANONICAL.names[joint] for joint in order if used[joint] < _LOW_SHARE][:_MAX_NAMED]
    return [line + (f", least in {', '.join(rare)}: there the capture corrects it, or is filtered" if rare else "")]


def _format_faults(done: DenoiseSolution) -> list[str]:
    """Format the artefacts, a line for each kind, the worst joints first."""
    lines = []
    for kind in dict.fromkeys(fault.kind for fault in done.faults):
        joints: dict[str, list] = {}
        for fault in done.faults:
            if fault.kind == kind:
                joints.setdefault(fault.joint, []).append(fault)
        worst = sorted(joints.items(), key=lambda item: -max(fault.amount for fault in item[1]))
        named = []
        for name, found in worst[:_MAX_NAMED]:
            top = max(found, key=lambda fault: fault.amount)
            amount = f" {top.amount:.1f} {top.unit}" if top.unit else f" {sum(f.stop - f.start for f in found)} frames"
            named.append(f"{name}{amount}" + (f" ({len(found)} times)" if len(found) > 1 else ""))
        rest = len(worst) - len(named)
        lines.append(f"{kind}: {', '.join(named)}" + (f" and {rest} more joints" if rest > 0 else ""))
    return lines


def _format_densities(done: DenoiseSolution) -> list[str]:
    """Format which densities counted, the likelihood under each, and where they were out of their depth."""
    parts = done.density_intervals
    if not parts:
        return []
    whole = sum(part.stop - part.start for part in parts)
    densities = []
    for name in parts[0].nats:
        nats = sum(part.nats.get(name, 0.0) * (part.stop - part.start) for part in parts) / whole
        used = sum(part.stop - part.start for part in parts if part.prior == name)
        densities.append(f"{name} {nats:.0f} nats a frame, used in {used}")
    lines = [f"prior: {', '.join(densities)} of {whole} frames"]
    low = [f"{part.start}:{part.stop}" for part in parts if part.weight < _LOW_WEIGHT]
    if low:
        rest = f" and {len(low) - _MAX_NAMED} more windows" if len(low) > _MAX_NAMED else ""
        intervals = ", ".join(low[:_MAX_NAMED])
        lines.append(f"prior out of its depth, so that it counts for less than half: frames {intervals}{rest}")
    return lines


def _run_folder(command: Denoise) -> int:
    """Check, denoise what is not done yet, list what failed."""
    for name in ("mask", "video", "prior", "causal", "strict"):
        if getattr(command, name):
            raise RequestError(f"--{name} is for single files; {command.source} is a folder")
    if command.cluster not in (None, "local") and command.jobs != 1:
        raise RequestError(f"--jobs is for this machine; the cluster at {command.cluster} has workers of its own")
    if command.report is not None:
        outputs.check_folder(command.report)
    denoiser, inbetweener = map(priors.add_set, (command.denoiser, command.inbetweener or "transformer"))
    # A typing error is reported once, now; and what processes use is recorded here.
    _load(priors.load_denoiser, denoiser)
    _load(priors.load_inbetweener, inbetweener)
    named = replace(command, denoiser=denoiser, inbetweener=inbetweener)
    return folders.run_folder(
        command.source,
        command.out,
        FileDenoiser(named, inputs.read_rig(command.rig, command)),
        command,
        label="denoising",
        done="denoised",
        cluster=command.cluster,
    )


@dataclass(frozen=True)
class FileDenoiser:
    """Denoiser of the files of a folder, cheap to send to a process, which loads the networks on first use."""

    command: Denoise
    """Options for the folder; networks are named with their set of weights."""
    rig: Rig | None
    """Rig of all files, where it is not the one that would be recognised."""

    def __call__(self, source: Path, out: Path) -> tuple[int, float]:
        """Denoise one file and write the result and its report; return frames and seconds of compute."""
        torch.set_num_threads(1)
        report = self.command.report
        if report is not None:
            report = (report / out.relative_to(self.command.out)).with_suffix(".json")
            report.parent.mkdir(parents=True, exist_ok=True)
        command = replace(self.command, source=source, out=out, report=report)
        with weight_sets.record_licences():
            done = _denoise_file(command, self.rig)
            results.write_result("denoise", command, done, done.capture, rig=done.rig)
        return done.motion.num_frames, done.seconds
