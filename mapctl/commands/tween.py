"""`mapctl tween`: a few keys to a whole motion."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from mapctl.commands import beside, options, tween_variations
from mapctl.commands.frames import parse_frame
from mapctl.commands.threads import compute_on_one
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from controllers.filling import Infilled
    from controllers.tween import Keys
    from mapctl.motion import Motion


@dataclass(frozen=True)
class Tween:
    """Frames of a clip are keys, and the motion between them is made anew. On any known rig."""

    source: options.InFile
    """A motion file."""
    out: options.OutFile
    """Where the motion goes: as long as IN."""
    keyframes: Annotated[str, arg(metavar="F,F,...")]
    """Frames that stay, or seconds as in 1.5s; the first and the last one are whole poses."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Keys between the first and the last only tell where these hands or feet are."""
    root_only: bool = False
    """Keys between the first and the last only tell where the hips are and which way they face."""
    method: Annotated[Literal["map", "infiller", "slerp"], arg(metavar="map|infiller|slerp")] = "map"
    """map: the infiller proposes, the MAP stage finishes. infiller: its proposal on rigid bones. slerp: none of it."""
    rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    infiller: options.Name = "infiller"
    """The bundled infiller, or the file or run folder of a trained one."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier."""
    variations: options.Count = 1
    """How many different motions to make, as OUT_000.bvh, OUT_001.bvh, ...: the first is what one would be, in the
    others densities (--prior, or auto) are drawn from and steered from key to key."""
    seed: options.Count = 0
    """Of everything that is drawn; the first variations are the same however many are asked for."""
    report: options.MaybeFile = None
    """JSON with the keys, what is missed at them, contacts, ledger, measures and timing."""
    video: options.MaybeFile = None
    """Film of the given motion and the new one side by side: .mp4, .gif or .png."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, make, write, tell."""
        compute_on_one()
        self._check()
        rig = options.read_rig(self.rig)
        motion = options.read_motion(self.source, rig)
        keys = self._keys(motion)
        if self.variations > 1:
            tween_variations.run(self, motion, keys)
            return 0
        done = self._made(motion, keys)
        from mapctl import formats

        formats.save(done.motion, self.out)
        if self.report is not None:
            from mapctl import report

            report.write(self._as_report(done, motion, keys), self.report)
        beside.film(motion, done.motion, self.video, rig=rig, quiet=self.quiet)
        if not self.quiet:
            ms = 1000 * done.seconds / done.motion.num_frames
            print(f"{self.out}: {done.motion.num_frames} frames through {len(keys.frames)} keys; {ms:.1f} ms a frame")
            for note in done.notes:
                print(note)
        return 0

    def _check(self) -> None:
        if self.joints is not None and self.root_only:
            raise RequestError("--joints and --root-only are two kinds of keys; choose one")
        tween_variations.check(self)

    def _keys(self, motion: "Motion") -> "Keys":
        from controllers.tween import Keys

        frames = [parse_frame(word, fps=float(motion.fps)) for word in self.keyframes.split(",")]
        limbs = () if self.joints is None else tuple(name.strip() for name in self.joints.split(","))
        return Keys(tuple(frames), limbs=limbs, root_only=self.root_only)

    def _made(self, motion: "Motion", keys: "Keys") -> "Infilled":
        import priors
        from controllers.filling import InfillSettings
        from controllers.tween import tween

        method = "linear" if self.method == "slerp" else self.method
        infiller = None if method == "linear" else priors.load_infiller(self.infiller)
        densities = priors.load_choice(self.prior)
        settings, rig = InfillSettings(method=method), options.read_rig(self.rig)
        return tween(motion, keys, infiller, settings=settings, densities=densities, rig=rig)

    def _as_report(self, done: "Infilled", motion: "Motion", keys: "Keys") -> dict[str, object]:
        from controllers.tween import key_errors

        missed = key_errors(done.motion, motion, keys, options.read_rig(self.rig))
        return beside.report("tween", self, done.motion, {"keys": missed, **done.summary()})
