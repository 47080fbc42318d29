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
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats import smpl
from mapctl.metrics import feet
from mapctl.motion import Motion
from mapctl.retarget import as_rig, identify_rig
from mapctl.retarget.carry import Changes, RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig
from mapctl.robots import files as robot_files
from mapctl.robots import model as robot_model
from mapctl.robots import plausibility
from mapctl.robots.model import Robot
from mapctl.robots.retarget import RobotMotion, retarget_to_robot


@dataclass(frozen=True)
class Convert(Command, options.ReadOptions, options.FolderOptions):
    """Write a motion, or a folder of them, in another format, on another skeleton or at another frame rate, or some
    frames of it; mirrored, with planted feet, as a loop, in place, or with its travel on the root joint.

    The edits are applied in this order: frames, rig, frame rate, mirror, loop, feet, travel.
    """

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """.bvh, .npz (mapctl's, or SMPL parameters), .pt (SMPL parameters, as of GVHMR), positions of markers or joints
    (.c3d, .trc, .csv, .npy), to which a body is fitted, or .amc: its skeleton is the .asf of the same name, else the
    only one in the folder, else named as in subject.asf+take.amc. Of a character (.glb, .gltf, .vrm, .vrma, .usda,
    .usdc, .usd, .usdz, .fbx) its first animation, else one frame of its rest pose; hero.glb#ARMATURE,
    hero.glb#ARMATURE/ANIMATION and hero.glb#/ANIMATION choose others. Or a folder, every motion below it."""
    out: Positional[Annotated[Path, arg(metavar="OUT|FOLDER")]]
    """.bvh, .npz, or with a skinned body .glb, .usda, .usdc, .usd or .fbx (by Blender, which must be installed): that
    of the character in IN or in --rig, where it came from such a file, else a mannequin. A .vrm is written of a VRM
    character only. A .vrma holds motion alone: of the bones of a VRM, or of any rig's canonical joints. Of a folder
    another one, which gets the same names. With --robot .csv or .npz: base and joint angles of the robot."""
    to: Annotated[str | None, arg(metavar=".ENDING")] = None
    """For a folder: the ending of all results, as .glb; their own if not given, or .bvh."""
    rig: Annotated[str | None, arg(metavar="canonical|PRESET|FILE.toml|CLIP")] = None
    """`canonical`: canonical joints with the performer's own bones; or a clip whose skeleton is wanted, on which the
    character has its floor and planted feet, in the clip's layout; or a rig by name or TOML file, whose joints
    get the bones of the canonical body."""
    as_: Annotated[Literal["smpl"] | None, arg(name="as")] = None
    """`smpl`: write SMPL parameters in the layout of AMASS, as .npz: poses, trans and mocap_framerate, Z up."""
    robot: options.MaybeFile = None
    """Robot that moves as the person does, as MJCF or URDF: OUT is a .csv (a row a frame: position of the base, its
    quaternion xyzw, joint angles in the model's order) or an .npz (also velocities, bodies and contacts). With such
    a .csv as IN: the robot that it is of. A .toml of the same name beside the model overrules which of its links
    is which part of a person."""
    header: bool = False
    """For a robot's .csv: a first row with the names of the columns."""
    smpl_model: options.MaybeFile = None
    """Body model for SMPL parameters in IN, an .npz of your own with v_template, shapedirs and J_regressor: bones and
    floor are those of the file's betas. Without it the bones are those of the canonical body."""
    ground: Literal["fit", "keep"] = "fit"
    """Supports such as stairs and platforms, on the skeleton of another rig: `fit` scales their height with the
    legs, `keep` keeps it in metres."""
    report: options.MaybeFile = None
    """Report of the changes in retargeting, as JSON: scale, travel, hips, feet and hands that do not
    get where they should; of a robot also limits, speeds, self-contact, balance and feet of each second."""
    source_rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    frames: Annotated[str | None, arg(metavar="A:B")] = None
    """Only these frames of IN, or seconds as in 2s:4s; B is the first that is left out."""
    fps: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second, as 30, 29.97 or 30000/1001: positions linear, rotations by slerp."""
    fps_in: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second of a file that does not state them: an .amc, 120 unless given; SMPL parameters, a .csv or an
    .npy, 30."""
    markers: options.MaybeMarkers = None
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


@dataclass(frozen=True, eq=False)
class Converted:
    """A converted motion."""

    motion: Motion
    """The motion, on its rig and in its layout."""
    lines: tuple[str, ...]
    """Edits applied, one sentence each."""
    changes: Changes | None
    """Changes in retargeting to another rig."""
    robot: RobotMotion | None = None
    """The motion of the robot that it was retargeted to."""


@dataclass(frozen=True)
class Conversion:
    """Parsed options, cheap to send to a process."""

    command: Convert
    fps: Fraction | None
    """Frames per second of the result."""
    fps_in: Fraction | None
    """Frames per second of a file that does not state them."""
    source_rig: Rig | None
    body: RiggedCharacter | None = None
    """Body that gets the motion; None for the canonical joints, or for the motion's own."""
    robot: Robot | None = None
    """Robot of the motion that is read or written."""

    @staticmethod
    def of(command: Convert) -> "Conversion":
        """Parse the options; RequestError for those that are none or do not go together."""
        if command.in_place and command.root_motion:
            raise RequestError("--in-place takes the travel out and --root-motion puts it on the root; choose one")
        if command.as_ is not None and (
            command.rig is not None or (command.to or command.out.suffix) not in (".npz", "npz")
        ):
            raise RequestError("--as smpl is a body of its own in an .npz; leave --rig out, and name an .npz")
        fps, fps_in = (None if text is None else parse_fps(text) for text in (command.fps, command.fps_in))
        body = None if command.rig in (None, "canonical") else inputs.read_rigged(command.rig)
        if command.as_ is not None:
            body = RiggedCharacter.of(Motion.at_rest(smpl.build_skeleton(smpl.JOINTS[0])), None)[1]
        if command.robot is None and command.header:
            raise RequestError("--header is for the .csv of a robot; name one by --robot")
        robot = None if command.robot is None else robot_model.load(command.robot)
        found = Conversion(command, fps, fps_in, inputs.read_rig(command.source_rig, command), body, robot)
        if robot is not None and not found.to_robot and command.source.suffix.lower() != ".csv":
            raise RequestError("--robot is for a robot's motion; name OUT .csv or .npz (--to of a folder), or IN .csv")
        return found

    @property
    def to_robot(self) -> bool:
        """Whether the results are a robot's."""
        ending = f".{(self.command.to or self.command.out.suffix).lower().removeprefix('.')}"
        return self.robot is not None and self.command.as_ is None and ending in robot_files.ENDINGS

    def convert(self, source: Path) -> Converted:
        command, rig = self.command, self.source_rig
        may_lack = source.suffix.lower() in formats.MAY_LACK_RATE
        fps_in = self.fps_in if may_lack or not command.source.is_dir() else None
        if self.robot is not None and source.suffix.lower() == ".csv":
            motion = robot_files.load_csv(source, self.robot, fps_in or Fraction(PRIOR_FPS)).to_motion()
            rig = replace(as_rig(self.robot.rigmap), up="y")
        else:
            motion = inputs.read_motion(
                source, rig, fps=fps_in, body_model=command.smpl_model, markers=command.markers, quiet=command.quiet
            )
        edited = command.mirror or command.loop or command.plant_feet or command.in_place or command.root_motion
        if edited and command.rig is None:  # before frames are cut, since the whole clip shows the rig
            rig = as_rig(identify_rig(motion.skeleton, rig, motion=motion))
        if command.frames is not None:
            fps, frames = float(motion.fps), motion.num_frames
            motion = motion.slice(*options.parse_range(command.frames, fps=fps, frames=frames, what="range of frames"))
        changes, cycle, lines = None, None, list[str]()
        if command.rig == "canonical":
            motion, rig = retarget.to_canonical(motion, rig)[0], retarget.load_rig("canonical")
        elif command.as_ is not None and (ordered := smpl.order_joints(motion)) is not None:
            motion = ordered
        elif self.body is not None:
            found = retarget_motion(motion, self.body, rig, ground=command.ground)
            original = motion if motion.skeleton.matches(self.body.rigmap.rig_skeleton) else None
            motion = self.body.on_rig(found.motion, original=original, fingers=found.fingers)
            rig, changes = as_rig(self.body.rigmap), found.changes
        if self.fps is not None:
            motion = motion.resample(self.fps)
        if command.mirror:
            motion = editing.mirror(motion, rig)
        if command.loop:
            loop = editing.close_loop(motion, rig)
            motion, cycle = loop.motion, loop.travel
            frames = f"{loop.cycle.start}:{loop.cycle.stop}"
            lines.append(f"loop: frames {frames}, {motion.seconds:.2f} s, travel {cycle.distance:.2f} m")
        if command.plant_feet:
            planted = editing.plant_feet(motion, rig, cycle=cycle)
            lines.append(f"feet: {_describe_feet(motion, rig)} before, {_describe_feet(planted, rig)} after")
            motion = planted
        if command.in_place:
            motion = editing.remove_travel(motion, rig, cycle)
        if command.root_motion:
            motion = editing.move_travel_to_root(motion, rig, cycle)
        ending = (command.to or command.out.suffix).lstrip(".").lower()
        if ending == "vrma" and not getattr(motion.source, "humanoid", None):  # no other rig is one that it names
            motion = retarget.to_canonical(motion, rig)[0]
        if not self.to_robot:
            return Converted(motion, tuple(lines), changes)
        assert self.robot is not None
        robot, changes = retarget_to_robot(motion, self.robot, rig)
        return Converted(motion, tuple(lines), changes, robot)

    def save(self, done: Converted, out: Path) -> None:
        """Write a converted motion."""
        if done.robot is not None:
            robot_files.save(done.robot, out, header=self.command.header)
        else:
            (formats if self.command.as_ is None else smpl).save(done.motion, out)

    def __call__(self, source: Path, out: Path) -> tuple[int, float]:
        """Convert one file of a folder and write the result; return its frames and the seconds that it took."""
        start = perf_counter()
        done = self.convert(source)
        self.save(done, out)
        return done.motion.num_frames, perf_counter() - start


def parse_fps(text: str) -> Fraction:
    """Parse a frame rate as a number or a fraction; RequestError for what is none or beyond 1000."""
    try:
        fps = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"a frame rate is a number, as 30, 29.97 or 30000/1001, got {text!r}") from None
    if not Fraction(1, 100) <= fps <= 1000:
        raise RequestError(f"the frame rate must be 0.01 to 1000, got {text}")
    return fps


def _describe_feet(motion: Motion, rig: Rig | None) -> str:
    toes = feet.ToeMeasurements.of(RiggedMotion.of(motion, rig).positions("Toes"), float(motion.fps))
    return f"planted toes {100 * feet.contact_speed(toes):.1f} cm/s, skate {100 * feet.skate(toes):.1f} cm/s"


def _describe_robot(seconds: list[plausibility.Second]) -> str:
    worst = plausibility.find_worst(seconds)
    limits = "held" if worst.limit_excess_deg == 0 else f"exceeded by {worst.limit_excess_deg:.1f} deg"
    speed = f", {worst.speed_share:.0%} of its largest" if worst.speed_share else ""
    return (
        f"worst frames: limits {limits}, joints {worst.speed_rad_s:.1f} rad/s{speed}, standing feet slide"
        f" {worst.slide_cm_s:.1f} cm/s, soles {worst.sole_low_cm:.1f} to {worst.sole_high_cm:.1f} cm, links"
        f" {worst.self_contact_cm:.1f} cm in each other, centre of mass {worst.balance_cm:.0f} cm off its support"
    )


def run(command: Convert) -> int:
    if command.rig is None and command.ground != "fit":
        raise RequestError("--ground is about motion on another rig; name one by --rig")
    if command.rig is None and command.robot is None and command.report is not None:
        raise RequestError("--report is about motion on another rig or robot; name one by --rig or --robot")
    if command.source.is_dir():
        if command.report is not None:
            raise RequestError("--report is on one file; a folder has none")
        ending = None if command.to is None else f".{command.to.lower().removeprefix('.')}"
        conversion = Conversion.of(command)
        if ending is not None and not conversion.to_robot:
            formats.check_ending(f"a{ending}")
        return folders.run_folder(
            command.source, command.out, conversion, command, label="converting", done="converted", ending=ending
        )
    folders.refuse_options(command, command.source, "to")
    conversion = Conversion.of(command)
    if not conversion.to_robot:
        formats.check_ending(command.out)
    outputs.check_files([command.out, *options.collect_paths(command.report)])
    done = conversion.convert(command.source)
    conversion.save(done, command.out)
    seconds = [] if done.robot is None else plausibility.assess(done.robot)
    if command.report is not None and done.changes is not None:
        request = options.describe_request("convert", command)
        changes = asdict(done.changes) | {"notes": list(done.changes.notes)}
        found = {"mapctl": __version__, "request": request, "changes": changes}
        if seconds:
            found["seconds"] = [asdict(second) for second in seconds]
        report.write_report(found, command.report)
    if not command.quiet:
        rate = f"{float(done.motion.fps):.6g} frames a second"
        joints = done.motion.num_joints if done.robot is None else len(done.robot.robot.joints)
        size = f"{done.motion.num_frames} frames, {joints} joints"
        notes = [] if done.changes is None else [f"note: {note}" for note in done.changes.notes]
        lines = [f"{command.out}: {size}, {rate}", *notes, *done.lines]
        print("\n".join([*lines, _describe_robot(seconds)] if seconds else lines))
    return 0
