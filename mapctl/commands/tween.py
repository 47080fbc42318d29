"""`mapctl tween`: a few keys to a whole motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from mapctl.commands.shared import options, results, tween_variations
from mapctl.commands.shared.frame_syntax import parse_frame
from mapctl.commands.shared.tables import print_table
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import FileFormatError, RequestError

if TYPE_CHECKING:
    from controllers.inbetweening.keyframe_poses import KeyframeClip
    from controllers.inbetweening.keyframe_timing import KeyInterval
    from controllers.inbetweening.pipeline import InfillResult
    from mapctl.intent.keyframe_toml import KeyRequest
    from mapctl.retarget.rigs import Rig


@dataclass(frozen=True)
class Tween:
    """Frames of a clip are keys, or poses that a file puts in time and place, and the motion between them is made anew.
    On any known rig."""

    source: options.InFile
    """A motion file; or a TOML file of [[key]] tables: a frame or seconds, a pose (a motion file and a pose_frame of
    it), a place = [x, z], height and facing_deg of the hips, and joints, reach or root_only where not all of it counts
    (docs/infilling.md)."""
    out: options.OutFile
    """Where the motion goes: as long as IN, or until the last key."""
    keyframes: Annotated[str | None, arg(metavar="F,F,...")] = None
    """Of a motion file, frames that stay, or seconds as in 1.5s; the first and the last one are whole poses."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Keys between the first and the last only tell where these hands or feet are: canonical names or the rig's own."""
    root_only: bool = False
    """Keys between the first and the last only tell where the hips are and which way they face."""
    suggest_timing: bool = False
    """Tell how many frames the way from each whole pose to the next takes in mocap, beside what is given; the motion
    keeps the given timing."""
    method: Annotated[Literal["map", "infiller", "slerp"], arg(metavar="map|infiller|slerp")] = "map"
    """map: the infiller proposes, or a density is rolled between keys so far apart that the infiller would slide, and
    the MAP stage finishes; a note tells for every gap who proposed. infiller: its proposal on rigid bones. slerp: none
    of it."""
    rig: options.MaybeRig = None
    """The rig of IN or of its body, where it is not the one that would be recognised; see `mapctl info`."""
    infiller: options.MaybeName = None
    """The file or run folder of a trained infiller; the bundled one if not given."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier."""
    variations: options.Count = 1
    """How many different motions to make, as OUT_000.bvh, OUT_001.bvh, ...: the first is what one would be, in the
    others densities (--prior, or auto) are drawn from and steered from key to key."""
    best_of: options.Count = 1
    """Of so many answers the one with the least energy is kept: from the infiller's proposal, slerp's, and rollouts of
    densities (--prior, or auto) that are steered from key to key."""
    seed: options.Count = 0
    """Of everything that is drawn; the first variations are the same however many are asked for."""
    report: options.MaybeFile = None
    """JSON with the keys, what is missed at them, contacts, ledger, measures, compute and suggested timing."""
    video: options.MaybeFile = None
    """Film of the given motion and the new one side by side: .mp4, .gif or .png."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, make, write, tell."""
        use_single_thread()
        request = self._read_key_request()
        self._check([self.source] if request is None else [self.source, *map(Path, request.files)])
        asked = self._asked(request)
        if self.variations > 1:
            tween_variations.run_variations(self, asked)
            return 0
        intervals = self._timing(asked)
        done = self._run_tweening(asked)
        from mapctl import formats

        formats.save(done.motion, self.out)
        if self.report is not None:
            from mapctl import report

            report.write_report(self._build_report(done, asked, intervals), self.report)
        results.film_comparison(asked.motion, done.motion, self.video, rig=asked.rig, quiet=self.quiet)
        if not self.quiet:
            self._tell(done, asked, intervals)
        return 0

    def _tell(self, done: "InfillResult", asked: "KeyframeClip", intervals: "Sequence[KeyInterval]") -> None:
        ms, count = 1000 * done.seconds / done.motion.num_frames, len(asked.keys.frames)
        print(f"{self.out}: {done.motion.num_frames} frames through {count} keys; {ms:.1f} ms a frame")
        for note in (*done.notes, *done.gap_notes):
            print(note)
        if intervals:
            rows = [(i.start, i.stop, i.given, i.suggested, i.reason) for i in intervals]
            print_table(("key", "next", "given", "suggested", "why"), rows, title="frames between keys")

    def _timing(self, asked: "KeyframeClip") -> "list[KeyInterval]":
        from controllers.inbetweening.keyframe_timing import suggest_intervals

        return suggest_intervals(asked.motion, asked.keys, asked.rig) if self.suggest_timing else []

    @property
    def _is_key_file(self) -> bool:
        """Whether the keys are those of a TOML file."""
        return self.source.suffix.lower() == ".toml"

    def _read_key_request(self) -> "KeyRequest | None":
        if not self._is_key_file:
            return None
        from mapctl.intent.keyframe_toml import read_keys

        return read_keys(self.source)

    def _check(self, given: Sequence[Path]) -> None:
        """Of the options; files that are given are read, and so not written."""
        if self.joints is not None and self.root_only:
            raise RequestError("--joints and --root-only are two kinds of keys; choose one")
        idle = [
            name
            for name, value in (
                ("--keyframes", self.keyframes),
                ("--joints", self.joints),
                ("--root-only", self.root_only or None),
            )
            if value is not None
        ]
        if self._is_key_file and idle:
            raise RequestError(f"{idle[0]} is for motion files; {self.source} says itself what its keys are")
        if not self._is_key_file and self.keyframes is None:
            raise RequestError("of a motion file, --keyframes says which frames are keys (see mapctl tween --help)")
        tween_variations.check_answers(self, given)
        # Variations are rolled by a density whatever the method.
        prior = self.prior if self.variations == self.best_of == 1 else None
        results.check_method(self.method, prior=prior, infiller=self.infiller)

    def _asked(self, request: "KeyRequest | None") -> "KeyframeClip":
        """The motion that holds the keys, these, and its rig where it is known."""
        from controllers.inbetweening.keyframe_poses import KeyframeClip
        from controllers.inbetweening.keyframes import check_effectors
        from mapctl.intent.keyframes import Keys

        rig = options.read_rig(self.rig)
        if request is not None:
            return self._load_key_file(request, rig)
        motion = options.read_motion(self.source, rig)
        frames = [parse_frame(word, fps=float(motion.fps)) for word in (self.keyframes or "").split(",")]
        if len(set(frames)) == 2 and (self.root_only or self.joints is not None):
            name = "--root-only" if self.root_only else "--joints"
            raise RequestError(f"{name} is about keys between the first and the last, and --keyframes has none there")
        limbs = () if self.joints is None else tuple(name.strip() for name in self.joints.split(","))
        if limbs:  # also where there is no key between the first and the last
            check_effectors(limbs, motion, rig)
        return KeyframeClip(motion, Keys.of(frames, limbs=limbs, root_only=self.root_only), rig)

    def _load_key_file(self, request: "KeyRequest", rig: "Rig | None") -> "KeyframeClip":
        from controllers.inbetweening.keyframe_poses import build_keyframe_clip

        try:
            return build_keyframe_clip(request, rig)
        except RequestError as error:
            raise FileFormatError(self.source, str(error)) from error

    def _run_tweening(self, asked: "KeyframeClip") -> "InfillResult":
        import priors
        from controllers.inbetweening.pipeline import InfillSettings
        from controllers.inbetweening.tween import tween

        method = "linear" if self.method == "slerp" else self.method
        infiller = None if method == "linear" else priors.load_infiller(self.infiller or "infiller")
        densities = priors.load_choice(self.prior)
        settings = InfillSettings(method=method)
        if self.best_of > 1 and infiller is not None:
            return tween_variations.tween_lowest_energy(self, asked, infiller, settings)
        rollout_densities = () if method != "map" else priors.load_choice(self.prior or "auto")
        return tween(
            asked.motion,
            asked.keys,
            infiller,
            settings=settings,
            densities=densities,
            rig=asked.rig,
            rollout_densities=rollout_densities,
        )

    def _build_report(
        self, done: "InfillResult", asked: "KeyframeClip", intervals: "Sequence[KeyInterval]"
    ) -> dict[str, object]:
        from controllers.inbetweening.tween import measure_keyframe_errors

        missed = measure_keyframe_errors(done.motion, asked.motion, asked.keys, asked.rig)
        timing = {"timing": [interval.summary() for interval in intervals]} if self.suggest_timing else {}
        return results.build_report("tween", self, done.motion, {"keys": missed, **timing, **done.summary()})
