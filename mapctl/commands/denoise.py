"""`mapctl denoise`: a noisy capture comes back clean, on its own rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import options, outputs, results
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError
from mapctl.runtime.progress import show_progress

if TYPE_CHECKING:
    from controllers.denoising.result import DenoiseResult

_EXIT_NOT_SATISFIED = 3
_MAX_NAMED = 6
_LOW_WEIGHT = 0.5  # of a density's weight
_DEFAULT_DELAY = 0.2  # seconds


@dataclass(frozen=True)
class Denoise:
    """A noisy, sliding, gappy capture of any known rig comes back clean: same skeleton, names, frames and rate."""

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """A motion file; or a folder, every motion below it."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT|FOLDER")]
    """Where the clean motion goes; of a folder, another one, which gets the same names."""
    rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    mask: options.MaybeFile = None
    """CSV with the columns joint, start, stop: frames (from 0, stop exclusive) in which a joint of the rig is not to be
    believed. `*` stands for everything, `root position` for where it is. What is nan in IN is not believed either."""
    sigma_deg: options.MaybeNumber = None
    """Noise of every joint's angles, degrees; told from the capture, joint by joint, if not given."""
    sigma_cm: options.MaybeNumber = None
    """Noise of the place of the hips, centimetres; told from the capture if not given."""
    anchor: bool = False
    """Let the body go where its planted feet say, for captures in which it drifts against them. The way over the
    ground changes."""
    causal: bool = False
    """As a live capture would be cleaned: a frame is decided at most `--delay` after it came."""
    delay: options.MaybeNumber = None
    """Seconds within which --causal decides a frame, at any frame rate, but for the compute; 0.2 if not given."""
    denoiser: options.Name = "denoiser"
    """The bundled denoiser, or the file or run folder of a trained one."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the last stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. None if not given, which measures as well."""
    report: options.MaybeFile = None
    """JSON with the faults found, corrections, contacts, ledger; of a folder, a folder of them."""
    plot: options.MaybeFile = None
    """PNG of joint angles before and after, and of the feet."""
    video: options.MaybeFile = None
    """Film of the capture and the result side by side: .mp4, .gif or .png."""
    jobs: options.Count = 1
    """Of a folder: how many files at once, each in a process of its own."""
    cluster: Annotated[str | None, arg(metavar="local|ADDRESS")] = None
    """Of a folder: over a ray cluster instead; `local` starts one on this machine with --jobs workers."""
    again: bool = False
    """Of a folder: do files again whose result is there already."""
    strict: bool = False
    """Exit with status 3 where the network was out of its depth for more than half of the frames."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, denoise, write, tell."""
        use_single_thread()
        if self.source.is_dir():
            from mapctl.commands.shared import denoise_folder

            return denoise_folder.run(self)
        self._check()
        done = self._run_denoising()
        from mapctl import formats

        formats.save(done.motion, self.out)
        if self.report is not None:
            from mapctl import report as reports

            reports.write_report(self.as_report(done), self.report)
        self._draw_pictures(done)
        if not self.quiet:
            self._tell(done)
        lost = float(done.proposal_share.mean()) < 0.5 and done.noise.max() > 0
        return _EXIT_NOT_SATISFIED if self.strict and lost else 0

    def as_report(self, done: "DenoiseResult") -> dict[str, object]:
        """The request, versions, and what the result says of itself."""
        return results.build_report("denoise", self, done.motion, done.summary())

    def _check(self) -> None:
        for name, idle in (("cluster", self.cluster is None), ("again", not self.again), ("jobs", self.jobs == 1)):
            if not idle:
                raise RequestError(f"--{name} is for folders; {self.source} is a file")
        results.check_destinations(self.out, self.video, self.report, self.plot, given=(self.source,))
        outputs.check_plot(self.plot)

    def _run_denoising(self) -> "DenoiseResult":
        import priors

        settings, masks, rig = self.settings(), self._masks(), options.read_rig(self.rig)
        densities = priors.load_choice(self.prior)
        denoiser, (motion, lost, _) = (
            priors.load_denoiser(self.denoiser),
            options.read_motion_with_gaps(self.source, rig),
        )
        masks = (*masks, *lost)
        with show_progress("denoising", quiet=self.quiet) as progress:
            if self.causal:
                from controllers.denoising.causal import denoise_causal

                delay = _DEFAULT_DELAY if self.delay is None else self.delay
                return denoise_causal(
                    motion, denoiser, masks=masks, settings=settings, delay=delay, rig=rig, progress=progress
                )
            from controllers.denoising.denoise import denoise

            return denoise(
                motion, denoiser, masks=masks, settings=settings, densities=densities, rig=rig, progress=progress
            )

    def settings(self):
        """What is known of the capture; RequestError for numbers that make no sense."""
        from controllers.denoising.denoise import DenoiseSettings

        if self.causal and self.prior is not None:
            raise RequestError("--causal has no time for a density; leave --prior out")
        if self.delay is not None and not self.causal:
            raise RequestError("--delay is how far --causal may look ahead; leave it out, or ask for both")
        return DenoiseSettings(sigma_deg=self.sigma_deg, sigma_cm=self.sigma_cm, anchor=self.anchor)

    def _masks(self):
        from mapctl.recording.masks import load_masks

        return () if self.mask is None else load_masks(self.mask)

    def _draw_pictures(self, done: "DenoiseResult") -> None:
        if self.plot is not None:
            from scenes.plots.denoising import plot

            plot(done.capture, done.motion, self.plot, rig=done.rig)
        results.film_comparison(done.capture, done.motion, self.video, rig=done.rig, quiet=self.quiet)

    def _tell(self, done: "DenoiseResult") -> None:
        summary = done.summary()
        moved = sum(summary["correction_cm"].values()) / len(summary["correction_cm"])
        print(
            f"{self.out}: {done.motion.num_frames} frames at {float(done.motion.fps):.6g} a second; joints moved by"
            f" {moved:.1f} cm on average; {summary['frame_ms']:.1f} ms a frame"
        )
        for line in format_faults(done):
            print(line)
        for note in (*done.notes, *format_densities(done)):
            print(note)


def format_faults(done: "DenoiseResult") -> list[str]:
    """The faults in a few lines, a line a kind."""
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


def format_densities(done: "DenoiseResult") -> list[str]:
    """Which densities counted, how likely the motion is under each, and where they were out of their depth."""
    if not done.stretches:
        return []
    frames = {name: 0 for name in done.stretches[0].nats}
    totals = dict.fromkeys(frames, 0.0)
    for part in done.stretches:
        frames[part.prior] += part.stop - part.start
        for name, nats in part.nats.items():
            totals[name] += nats * (part.stop - part.start)
    whole = sum(frames.values())
    told = ", ".join(f"{name} {totals[name] / whole:.0f} nats a frame, used in {frames[name]}" for name in frames)
    lines = [f"prior: {told} of {whole} frames"]
    doubted = [part for part in done.stretches if part.weight < _LOW_WEIGHT]
    if doubted:
        places = ", ".join(f"{part.start}:{part.stop}" for part in doubted[:_MAX_NAMED])
        rest = len(doubted) - _MAX_NAMED
        lines.append(
            f"prior out of its depth, so that it counts for less than half: frames {places}"
            + (f" and {rest} more windows" if rest > 0 else "")
        )
    return lines
