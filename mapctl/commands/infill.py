"""`mapctl infill`: gaps and lost joints of a motion are filled in."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import UseAppendAction, arg

from mapctl.commands.shared import options, results
from mapctl.commands.shared.frame_syntax import parse_ranges
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from controllers.inbetweening.infill import InfillResult
    from mapctl.motion import Motion
    from mapctl.recording.masks import Mask
    from mapctl.retarget.rigs import Rig


@dataclass(frozen=True)
class Infill:
    """What a motion lacks is filled in: frames, or joints; all else stays as it was. On any known rig."""

    source: options.InFile
    """A motion file."""
    out: options.OutFile
    """Where the whole motion goes."""
    gap: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="A:B")] = ()
    """Frames from A up to B (exclusive), or seconds as in 2s:4s; may be given several times. What stands in them does
    not matter. What is nan in IN is lost as well; where it is nothing, and there are no gaps and joints, frozen and
    leaping frames are looked for."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Only these joints are lost, canonical names or the rig's own: in the gaps, or throughout if there are none."""
    method: Annotated[Literal["infiller", "map", "linear"], arg(metavar="infiller|map|linear")] = "map"
    """map: the infiller proposes, the MAP stage finishes. infiller: its proposal on rigid bones. linear: none of it."""
    curve: options.MaybeCurve = None
    """Where the hips go in the gaps: a CSV or SVG file, or a shape, that passes within 1 m of where each begins and
    ends."""
    rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    infiller: options.MaybeName = None
    """The file or run folder of a trained infiller; the bundled one if not given."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. A gap at the end is extended into by it, by `auto` if
    none is named, where it knows what comes before."""
    report: options.MaybeFile = None
    """JSON with the gaps, contacts, ledger, measures and compute."""
    video: options.MaybeFile = None
    """Film of the given motion and the whole one side by side: .mp4, .gif or .png."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, fill, write, tell."""
        use_single_thread()
        self._check()
        rig = options.read_rig(self.rig)
        motion, marked, holed = options.read_motion_with_gaps(self.source, rig)
        masks = (*marked, *self._asked(motion)) or (() if holed else self._detect_gaps(motion))
        done = self._run_infilling(motion, masks, rig)
        from mapctl import formats

        formats.save(done.motion, self.out)
        if self.report is not None:
            from mapctl import report

            report.write_report(self.as_report(done), self.report)
        results.film_comparison(motion, done.motion, self.video, rig=rig, quiet=self.quiet)
        if not self.quiet:
            self._tell(done)
        return 0

    def as_report(self, done: "InfillResult") -> dict[str, object]:
        """The request, versions, and what the result says of itself."""
        return results.build_report("infill", self, done.motion, done.summary())

    def _check(self) -> None:
        if self.curve is not None and self.method == "linear":
            raise RequestError("--curve needs a network's steps; leave --method linear out")
        results.check_method(self.method, prior=self.prior, infiller=self.infiller)
        results.check_destinations(self.out, self.video, self.report, given=(self.source,))

    def _asked(self, motion: "Motion") -> Sequence["Mask"]:
        """What is lost by the options; RequestError for what cannot be."""
        from mapctl.recording.masks import ALL, Mask

        if not self.gap and self.joints is None:
            return ()
        gaps = parse_ranges(self.gap, fps=float(motion.fps), frames=motion.num_frames) or [(0, motion.num_frames)]
        names = [ALL] if self.joints is None else [name.strip() for name in self.joints.split(",")]
        return [Mask(name, start, stop) for start, stop in gaps for name in names]

    def _detect_gaps(self, motion: "Motion") -> Sequence["Mask"]:
        """What is wrong where nothing is marked; RequestError where nothing is."""
        from mapctl.recording.gap_detection import find_gaps

        return find_gaps(motion)

    def _run_infilling(self, motion: "Motion", masks: Sequence["Mask"], rig: "Rig | None") -> "InfillResult":
        import priors
        from controllers.inbetweening.infill import InfillSettings, infill

        infiller = None if self.method == "linear" else priors.load_infiller(self.infiller or "infiller")
        densities = priors.load_choice(self.prior)
        rollout_densities = () if self.method != "map" else priors.load_choice(self.prior or "auto")
        settings = InfillSettings(method=self.method)
        course = None if self.curve is None else options.read_curve(self.curve, None)
        return infill(
            motion,
            infiller,
            masks,
            settings=settings,
            densities=densities,
            rig=rig,
            course=course,
            rollout_densities=rollout_densities,
        )

    def _tell(self, done: "InfillResult") -> None:
        summary = done.summary()
        gaps = ", ".join(f"{gap['start']}:{gap['stop']} ({gap['joints']} joints)" for gap in summary["gaps"])
        print(
            f"{self.out}: {done.motion.num_frames} frames at {float(done.motion.fps):.6g} a second; filled {gaps};"
            f" {summary['frame_ms']:.1f} ms a filled frame"
        )
        for note in (*done.notes, *done.gap_notes):
            print(note)
