"""`mapctl convert`: any format to any format, other bones, another frame rate, and edits that everybody needs."""

from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mapctl import __version__, editing, formats, report, retarget
from mapctl.commands.shared import folders, inputs, options, outputs
from mapctl.commands.shared.command import Command
from mapctl.commands.shared.options import parse_range
from mapctl.editing import GroundTransform
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.errors import RequestError
from mapctl.metrics import feet
from mapctl.motion import Motion
from mapctl.retarget import as_rig, identify_rig
from mapctl.retarget.carry import Changes, GroundMode, RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig
from mapctl.runtime.file_jobs import FileJob, FileResult, run_over_processes, try_job


@dataclass(frozen=True)
class Convert(Command, options.ReadOptions):
    """Write a motion, or a folder of them, in another format, on another skeleton or at another frame rate, or some
    frames of it; mirrored, with planted feet, as a loop, in place, or with its travel on the root joint.

    What is asked for is done in this order: frames, rig, frame rate, mirror, loop, feet, travel.
    """

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """.bvh, .npz, .recording, or .amc: its skeleton is the .asf of the same name, else the only one in the folder, else
    named as in subject.asf+take.amc. Of a character (.glb, .gltf, .vrm, .vrma, .usda, .usdc, .usd, .usdz, .fbx) its
    first animation, else one frame of its rest pose; hero.glb#ARMATURE, hero.glb#ARMATURE/ANIMATION and
    hero.glb#/ANIMATION choose others. Or a folder, every motion below it."""
    out: Positional[Annotated[Path, arg(metavar="OUT|FOLDER")]]
    """.bvh, .npz, or with a skinned body .glb, .usda, .usdc or .usd: that of the character in IN or in --rig, where it
    came from such a file, else a mannequin. A .vrm is written of a VRM character only. A .vrma holds motion
    alone: of the bones of a VRM, or of any rig's canonical joints. Of a folder another one, which gets the same
    names."""
    to: Annotated[str | None, arg(metavar=".ENDING")] = None
    """For a folder: the ending of all results, as .glb; their own if not given, or .bvh."""
    rig: Annotated[str | None, arg(metavar="canonical|PRESET|FILE.toml|CLIP")] = None
    """`canonical`: canonical joints with the performer's own bones; or a clip whose skeleton is wanted, on which the
    character has its floor and planted feet, in the clip's layout; or a rig by name or TOML file, whose joints
    get the bones of the canonical body."""
    ground: Literal["fit", "keep"] = "fit"
    """Of what feet stand on, as stairs and platforms, on the skeleton of another rig: `fit` scales its height with the
    legs, `keep` keeps it in metres."""
    report: options.MaybeFile = None
    """Where to write what was changed on the way to the rig, as JSON: scale, travel, hips, feet and hands that do not
    get where they should."""
    source_rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    frames: Annotated[str | None, arg(metavar="A:B")] = None
    """Only these frames of IN, or seconds as in 2s:4s; B is the first that is left out."""
    fps: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second, as 30, 29.97 or 30000/1001: positions linear, rotations by slerp."""
    fps_in: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second of an .amc, which are not in the file; 120 unless given."""
    mirror: bool = False
    """Exchange left and right, on the same bones, through the plane x = 0."""
    loop: bool = False
    """Cut to the cycle of the motion, of a walk or a run one stride, and close it, to be played again and again."""
    plant_feet: bool = False
    """Hold planted toes still and on the floor by the legs; nothing else changes but for hips that must go down."""
    in_place: bool = False
    """Take out the travel over the ground: sway, bounce and heading stay."""
    root_motion: bool = False
    """Put the travel, position on the ground and heading, on the root joint above the hips; one is added where the rig
    has none."""
    jobs: options.Count = 1
    """For a folder: number of files at once, each in a process of its own."""
    again: bool = False
    """For a folder: convert files again whose result exists already."""
    quiet: bool = False
    """No summary and no progress bar."""


@dataclass(frozen=True, eq=False)
class Converted:
    """A converted motion."""

    motion: Motion
    """The motion, on its rig and in its layout."""
    rig: Rig | None = None
    """Its rig, as it was identified; None where nobody asked."""
    lines: tuple[str, ...] = ()
    """What was done to it, for the user."""
    cycle: GroundTransform | None = None
    """Travel by cycle, of a loop."""
    changes: Changes | None = None
    """What was changed on the way to another rig."""
    notes: tuple[str, ...] = ()
    """The same in sentences, as far as it is worth one."""


@dataclass(frozen=True)
class Conversion:
    """Parsed options, cheap to send to a process."""

    command: Convert
    """The command."""
    fps: Fraction | None
    """Frames per second of the result."""
    fps_in: Fraction | None
    """Frames per second of an .amc."""
    source_rig: Rig | None
    """Rig of what is read."""
    body: RiggedCharacter | None = None
    """Body that gets the motion; None for the canonical joints, or for the motion's own."""

    @staticmethod
    def of(command: Convert) -> "Conversion":
        """Parse the options; RequestError for those that are none or do not go together."""
        if command.in_place and command.root_motion:
            raise RequestError("--in-place takes the travel out and --root-motion puts it on the root; choose one")
        fps, fps_in = (None if text is None else parse_fps(text) for text in (command.fps, command.fps_in))
        return Conversion(command, fps, fps_in, inputs.read_rig(command.source_rig, command), read_body(command.rig))

    def convert(self, source: Path) -> Converted:
        """Read a file and convert it."""
        command = self.command
        done = self._cut(inputs.read_motion(source, self.source_rig, fps=self.fps_in, quiet=command.quiet))
        if command.rig is not None:
            done = transfer_to_rig(done.motion, self.body, self.source_rig, ground=command.ground)
            done = replace(done, lines=tuple(f"note: {note}" for note in done.notes))
        if self.fps is not None:
            done = replace(done, motion=done.motion.resample(self.fps))
        if command.mirror:
            done = replace(done, motion=editing.mirror(done.motion, done.rig))
        if command.loop:
            done = _loop(done)
        if command.plant_feet:
            done = _plant_feet(done)
        if command.in_place:
            done = replace(done, motion=editing.remove_travel(done.motion, done.rig, done.cycle))
        if command.root_motion:
            done = replace(done, motion=editing.move_travel_to_root(done.motion, done.rig, done.cycle))
        ending = (command.to or command.out.suffix).lstrip(".").lower()
        if ending == "vrma" and not getattr(done.motion.source, "humanoid", None):  # no other rig is one that it names
            done = replace(done, motion=retarget.to_canonical(done.motion, done.rig or self.source_rig)[0])
        return done

    def _cut(self, motion: Motion) -> Converted:
        """Cut the frames that are asked for, of a rig that the whole clip shows."""
        command = self.command
        edited = any((command.mirror, command.loop, command.plant_feet, command.in_place, command.root_motion))
        rig = self.source_rig
        if edited and command.rig is None:
            rig = as_rig(identify_rig(motion.skeleton, rig, motion=motion))
        if command.frames is None:
            return Converted(motion, rig)
        fps, frames = float(motion.fps), motion.num_frames
        start, stop = parse_range(command.frames, fps=fps, frames=frames, what="range of frames")
        return Converted(motion.slice(start, stop), rig)


def parse_fps(text: str) -> Fraction:
    """Parse a frame rate as a number or a fraction; RequestError for what is none or beyond 1000."""
    try:
        fps = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"a frame rate is a number, as 30, 29.97 or 30000/1001, got {text!r}") from None
    if not Fraction(1, 100) <= fps <= 1000:
        raise RequestError(f"the frame rate must be 0.01 to 1000, got {text}")
    return fps


def read_body(rig: str | None) -> RiggedCharacter | None:
    """Read the body that a --rig option names: of a clip, or a rig by name; None for `canonical` and without one.
    RequestError for rigs that are not known."""
    return None if rig in (None, "canonical") else RiggedCharacter.of(*inputs.read_rig_clip(rig))[1]


def transfer_to_rig(
    motion: Motion, body: RiggedCharacter | None, source_rig: Rig | None = None, *, ground: GroundMode = "fit"
) -> Converted:
    """Retarget a motion to a body in the layout of its file, or without one to the canonical joints; and note what
    could not be kept.

    A clip of the same skeleton stays as it is; others get their floor (see mapctl.retarget.carry), with stairs and
    platforms as `ground` says.
    """
    if body is None:
        return Converted(retarget.to_canonical(motion, source_rig)[0], retarget.load_rig("canonical"))
    found = retarget_motion(motion, body, source_rig, ground=ground)
    original = motion if motion.skeleton.matches(body.rigmap.rig_skeleton) else None
    on_rig = body.on_rig(found.motion, original=original, fingers=found.fingers)
    return Converted(on_rig, as_rig(body.rigmap), changes=found.changes, notes=found.notes)


def _loop(done: Converted) -> Converted:
    loop = editing.close_loop(done.motion, done.rig)
    frames, way = f"{loop.cycle.start}:{loop.cycle.stop}", f"{loop.travel.distance:.2f} m"
    line = f"loop: frames {frames}, {loop.motion.seconds:.2f} s, travel {way}"
    return replace(done, motion=loop.motion, cycle=loop.travel, lines=(*done.lines, line))


def _plant_feet(done: Converted) -> Converted:
    planted = editing.plant_feet(done.motion, done.rig, cycle=done.cycle)
    before, after = (_describe_feet(motion, done.rig) for motion in (done.motion, planted))
    return replace(done, motion=planted, lines=(*done.lines, f"feet: {before} before, {after} after"))


def _describe_feet(motion: Motion, rig: Rig | None) -> str:
    toes = feet.ToeMeasurements.of(RiggedMotion.of(motion, rig).positions("Toes"), float(motion.fps))
    return f"planted toes {100 * feet.contact_speed(toes):.1f} cm/s, skate {100 * feet.skate(toes):.1f} cm/s"


def run(command: Convert) -> int:
    """Read, convert, write: one file, or every one below a folder."""
    if command.rig is None and (command.report is not None or command.ground != "fit"):
        option = "--report" if command.report is not None else "--ground"
        raise RequestError(f"{option} is about motion on another rig; name one by --rig")
    if command.source.is_dir():
        return run_folder(command)
    for name, idle in (("to", command.to is None), ("again", not command.again), ("jobs", command.jobs == 1)):
        if not idle:
            raise RequestError(f"--{name} is for folders; {command.source} is a file")
    formats.check_ending(command.out)
    outputs.check_files([command.out, *options.collect_paths(command.report)])
    done = Conversion.of(command).convert(command.source)
    motion = done.motion
    formats.save(motion, command.out)
    _write_report(command, done)
    if not command.quiet:
        rate = f"{float(motion.fps):.6g} frames a second"
        print(
            "\n".join([f"{command.out}: {motion.num_frames} frames, {motion.num_joints} joints, {rate}", *done.lines])
        )
    return 0


def _write_report(command: Convert, done: Converted) -> None:
    """Write what was changed on the way to the rig, if a report is requested."""
    if command.report is None or done.changes is None:
        return
    request = options.describe_request("convert", command)
    changes = asdict(done.changes) | {"notes": list(done.notes)}
    report.write_report({"mapctl": __version__, "request": request, "changes": changes}, command.report)


@dataclass(frozen=True)
class FileConverter:
    """Converter of single files, cheap to send to a process."""

    conversion: Conversion
    """What is to be done with each."""

    def __call__(self, job: FileJob) -> FileResult:
        """Convert one file and write the result; errors are in what is returned, except DiskFullError."""
        return try_job(job, self._convert)

    def _convert(self, job: FileJob) -> tuple[int, float]:
        start = perf_counter()
        # Of other files than these the rate is in the file.
        fps_in = self.conversion.fps_in if job.source.suffix.lower() == ".amc" else None
        motion = replace(self.conversion, fps_in=fps_in).convert(job.source).motion
        job.out.parent.mkdir(parents=True, exist_ok=True)
        formats.save(motion, job.out)
        return motion.num_frames, perf_counter() - start


def run_folder(command: Convert) -> int:
    """Check, convert what is not done yet, list what failed."""
    if command.report is not None:
        raise RequestError("--report is on one file; a folder has none")
    if command.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {command.jobs}")
    ending = command.to
    if ending is not None:
        ending = ending.lower() if ending.startswith(".") else f".{ending.lower()}"
        formats.check_ending(f"a{ending}")
    converter = FileConverter(Conversion.of(command))
    jobs, skipped = folders.collect_jobs(command.source, command.out, again=command.again, ending=ending)
    ended = run_over_processes(jobs, converter, processes=command.jobs)
    found = folders.await_results(ended, len(jobs), label="converting", again=command.again, quiet=command.quiet)
    return folders.conclude(command.out, found, skipped, done="converted", quiet=command.quiet)
