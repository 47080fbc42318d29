"""What is hard about armatures, what users do wrong, Esc, undo, and the panel; mapctl itself is a stub.

python play_corners.py FOLDER PYTHON
"""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import armatures
import bpy
import numpy as np
import stage
from mathutils import Matrix

FRAMES = range(1, 13)
facts: dict = {"errors": {}, "apart": {}}


def use(mode: str) -> None:
    """Let the stub answer in this mode."""
    stage.set_command(sys.executable, stage.SCRIPTS / "stub.py", mode, stage.FOLDER)


def clear() -> None:
    """An empty scene."""
    for group in (bpy.data.objects, bpy.data.actions, bpy.data.curves):
        for each in list(group):
            group.remove(each)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base, scene.unit_settings.scale_length = 30, 1.0, 1.0
    scene.frame_set(1)


def animate(armature, seed: int = 1, places: tuple[str, ...] = ()) -> None:
    """Key every bone at three frames, and some bones' places."""
    rng = np.random.default_rng(seed)
    for frame in (1, 6, 12):
        for bone in armature.pose.bones:
            channel = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
            path = channel.get(bone.rotation_mode, "rotation_euler")
            setattr(bone, path, np.array(getattr(bone, path)) + rng.normal(size=len(getattr(bone, path))) * 0.4)
            bone.keyframe_insert(path, frame=frame)
            if bone.name in places:
                bone.location = rng.normal(size=3) * 0.2 / armature.scale[0]
                bone.keyframe_insert("location", frame=frame)


def apart(armature, run, bones: list[str] | None = None) -> float:
    """How far an operator moved the heads of bones, metres."""
    bones = bones or [bone.name for bone in armature.data.bones]
    before = armatures.joints_of(armature, bones, FRAMES)
    assert run() == {"FINISHED"}
    return float(np.abs(armatures.joints_of(armature, bones, FRAMES) - before).max())


def play_echoes() -> None:
    """What comes back as it was sent leaves every armature as it was."""
    use("echo")
    clear()
    armature = armatures.add_mixamo(imported=True)
    animate(armature, places=("mixamorig:Hips",))
    facts["apart"]["imported"] = apart(armature, bpy.ops.mapctl.clean_up)

    clear()
    armature = armatures.add_mixamo()
    animate(armature, places=("mixamorig:Hips",))
    armature.location, armature.rotation_euler = (3, 1, 0.5), (0.1, 0.2, 2.0)
    for frame, place in ((1, (0, 0, 0)), (12, (5, -2, 1))):
        armature.location = place
        armature.keyframe_insert("location", frame=frame)
        armature.pose.bones[0]["mood"] = float(frame)
        armature.pose.bones[0].keyframe_insert('["mood"]', frame=frame)
    facts["apart"]["object that is animated too"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["other curves"] = sorted(
        {c.data_path for c in armatures.curves_of(armature) if "rotation" not in c.data_path}
    )

    clear()
    bpy.context.scene.unit_settings.scale_length = 0.01
    armature = armatures.add_mixamo()
    armature.scale = (100, 100, 100)
    animate(armature)
    facts["apart"]["scene in centimetres"] = apart(armature, bpy.ops.mapctl.clean_up)

    clear()
    armature = armatures.add_mixamo()
    spine, arm, leg = (armature.data.bones[f"mixamorig:{name}"] for name in ("Spine2", "LeftArm", "LeftUpLeg"))
    spine.use_inherit_rotation = False
    arm.use_local_location = False
    animate(armature, places=("mixamorig:LeftUpLeg", "mixamorig:Hips"))
    facts["apart"]["bones that do not follow"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["travelling"] = sorted(
        {c.data_path.split('"')[1] for c in armatures.curves_of(armature) if c.data_path.endswith("location")}
    )
    facts["connected"] = leg.use_connect

    clear()
    armature = armatures.add_mixamo()
    animate(armature)
    pull = armature.pose.bones["mixamorig:LeftArm"].constraints.new("STRETCH_TO")
    pull.target = bpy.data.objects.new("far", None)
    pull.target.location = (0.8, 0.5, 1.9)
    bpy.context.collection.objects.link(pull.target)
    facts["apart"]["arm that is stretched"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["stretched told"] = stage.told()


def play_generated() -> None:
    """A generated rig that is animated by its IK controls."""
    use("echo")
    clear()
    rig = armatures.add_generated()
    armatures.select(rig)
    rng = np.random.default_rng(0)
    # Hands and feet are moved toward the body: within reach, so that limbs need not be longer than they are.
    aims = (
        ("hand_ik.L", "upper_arm_fk.L"),
        ("hand_ik.R", "upper_arm_fk.R"),
        ("foot_ik.L", "thigh_fk.L"),
        ("foot_ik.R", "thigh_fk.R"),
    )
    for frame in (1, 6, 12):
        for name, toward in aims:
            bone, rest = rig.pose.bones[name], rig.data.bones
            bone.matrix = (
                Matrix.Translation((rest[toward].head_local - rest[name].head_local) * rng.uniform(0.15, 0.3))
                @ rest[name].matrix_local
            )
        for name in ("torso", "chest", "hips", "hand_ik.L", "head", "toe_ik.R"):
            rig.pose.bones[name].rotation_quaternion = (1, *rng.normal(size=3) * 0.08)
        rig.pose.bones["torso"].location = rng.normal(size=3) * 0.02
        for bone in (
            rig.pose.bones[name] for name in (*(name for name, _ in aims), "torso", "chest", "hips", "head", "toe_ik.R")
        ):
            bone.keyframe_insert("location", frame=frame)
            bone.keyframe_insert("rotation_quaternion", frame=frame)
    switched = rig.pose.bones["upper_arm_parent.L"]
    switched["IK_FK"] = 0.0
    switched.keyframe_insert('["IK_FK"]', frame=1)
    trunk = [f"DEF-spine{end}" for end in ("", ".001", ".002", ".003", ".004", ".006")]
    limbs = ("shoulder", "upper_arm", "forearm", "hand", "thigh", "shin", "foot", "toe")
    bones = [*trunk, *(f"DEF-{limb}.{side}" for limb in limbs for side in "LR")]
    facts["apart"]["generated rig by IK"] = apart(rig, bpy.ops.mapctl.clean_up, bones)
    facts["generated told"] = stage.told()
    facts["turned"] = turn_of(rig, bones)

    facts["stretch is back"] = max(bone.ik_stretch for bone in rig.pose.bones)
    hands = ["DEF-hand.L", "DEF-hand.R", "DEF-foot.L", "DEF-foot.R", "DEF-spine", "DEF-spine.006"]
    rig.animation_data.action = bpy.data.actions["rigAction"]
    facts["apart"]["hands and feet by IK"] = apart(rig, bpy.ops.mapctl.clean_up, hands)

    rig.data.bones["upper_arm_fk.L"].name = "renamed"
    expect("generated rig of another kind", bpy.ops.mapctl.clean_up)


def turn_of(rig, bones: list[str]) -> float:
    """How far DEF bones are turned from the FK control's own, the largest of hands, feet and head, radians."""
    pairs = (("DEF-hand.L", "hand_fk.L"), ("DEF-foot.R", "foot_fk.R"), ("DEF-spine.006", "head"))
    return max(
        (
            (rig.pose.bones[a].matrix.to_quaternion() @ rig.data.bones[a].matrix_local.to_quaternion().inverted())
            .rotation_difference(
                rig.pose.bones[b].matrix.to_quaternion() @ rig.data.bones[b].matrix_local.to_quaternion().inverted()
            )
            .angle
        )
        for a, b in pairs
    )


def play_walks() -> None:
    """A character that stands anywhere follows the file, whose frames are the world's."""
    use("echo")
    clear()
    armature, drawn = armatures.add_mixamo(imported=True), armatures.add_curve(cyclic=True, height=0.4)
    holder = bpy.data.objects.new("holder", None)
    bpy.context.collection.objects.link(holder)
    for frame, place in ((1, (0, 0, 0)), (12, (2, 1, 1))):
        holder.location = place
        holder.keyframe_insert("location", frame=frame)
    armature.parent = holder
    bpy.context.scene.frame_preview_start, bpy.context.scene.use_preview_range = 5, True
    armatures.select(armature, drawn)
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.mapctl.walk("EXEC_DEFAULT", True, speed=1.5, seed=3, style="proud", seconds=2.5) == {"FINISHED"}
    facts["words"] = (stage.FOLDER / "words.txt").read_text().split("\n")
    armature = bpy.data.objects["mixamo"]
    facts["range"] = list(armature.animation_data.action.frame_range)
    root = armatures.joints_of(armature, ["mixamorig:Hips"], range(5, 17))[:, 0]
    facts["root"] = root.tolist()
    facts["curve"] = (stage.FOLDER / "curve.csv").read_text()
    knots = [drawn.matrix_world @ knot.co for knot in drawn.data.splines[0].bezier_points]
    facts["knots"] = [[knot.x, -knot.y] for knot in knots]
    bpy.context.scene.use_preview_range = False
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    facts["undone"] = [
        bpy.data.objects["mixamo"].animation_data is None,
        [each.name for each in bpy.data.actions],
        len(bpy.data.curves),
    ]


def expect(name: str, run, **options) -> None:
    """Note what the interface tells of an operator that cannot do its work, and that nothing was changed."""
    bpy.context.scene.frame_set(bpy.context.scene.frame_current)
    before = state()
    try:
        facts["errors"][name] = [str(run(**options)), ""]
    except RuntimeError as error:
        told = stage.told()[0]
        same = state() == before and stage.module("operators").Report.failed
        facts["errors"][name] = [told if told in str(error) else str(error), "unchanged" if same else "changed"]


def state() -> list:
    """All that an operator could have changed."""
    armature = bpy.context.object
    data = armature.animation_data
    return [
        sorted(each.name for each in bpy.data.actions),
        data.action.name if data and data.action else None,
        bpy.context.scene.frame_current,
        bpy.context.scene.frame_end,
        [tuple(map(tuple, bone.matrix_basis)) for bone in armature.pose.bones],
        len(bpy.data.objects),
    ]


def play_errors() -> None:
    """What users do wrong."""
    clear()
    walk, clean_up = bpy.ops.mapctl.walk, bpy.ops.mapctl.clean_up
    armature = armatures.add_mixamo()
    armatures.select(armature)
    stage.set_command("/nowhere/mapctl")
    expect("program that is not there", walk)
    stage.set_command(sys.executable, "-c", "pass")
    expect("program that is another", walk)
    use("old")
    expect("program that is old", walk)
    use("echo")
    expect("no curve", walk)
    expect("no action", clean_up)
    expect("no action to in-between", bpy.ops.mapctl.in_between)
    armature.animation_data_create()
    armature.pose.bones[0].keyframe_insert("location", frame=3)
    expect("one key", clean_up)
    expect("one key to in-between", bpy.ops.mapctl.in_between)
    armature.pose.bones[0].keyframe_insert("location", frame=4)
    expect("keys in every frame", bpy.ops.mapctl.in_between)
    animate(armature)
    expect("gap that is outside", bpy.ops.mapctl.fill_gap, first=8, last=13)
    expect("gap that is empty", bpy.ops.mapctl.fill_gap, first=8, last=7)
    expect("no bones selected", bpy.ops.mapctl.fill_gap, first=4, last=7, selected=True)
    armature.data.pose_position = "REST"
    expect("rest position", clean_up)
    armature.data.pose_position = "POSE"
    armature.scale = (1, 1, 1.5)
    bpy.context.view_layer.update()
    expect("uneven scale", clean_up)
    armature.scale = (-1, 1, 1)
    bpy.context.view_layer.update()
    expect("mirrored", clean_up)
    armature.scale = (1, 1, 1)
    bpy.context.view_layer.update()
    use("fail")
    expect("mapctl's own", clean_up)
    use("crash")
    expect("mapctl that crashes", clean_up)
    drawn = armatures.add_curve()
    drawn.data.splines.new("POLY")
    armatures.select(armature, drawn)
    use("echo")
    expect("curve of two splines", walk)
    armatures.select(drawn)
    facts["poll"] = [clean_up.poll(), walk.poll()]


def play_selection() -> None:
    """Selected bones alone are filled."""
    use("echo")
    clear()
    armature = armatures.add_mixamo()
    animate(armature)
    armatures.select(armature)
    bpy.ops.object.mode_set(mode="POSE")
    bpy.ops.pose.select_all(action="DESELECT")
    for name in ("mixamorig:LeftArm", "mixamorig:LeftHand"):
        bone = armature.pose.bones[name]
        (bone if hasattr(bone, "select") else bone.bone).select = True
    assert bpy.ops.mapctl.fill_gap(first=4, last=7, selected=True) == {"FINISHED"}
    facts["gap words"] = (stage.FOLDER / "words.txt").read_text().split("\n")
    bpy.ops.object.mode_set(mode="OBJECT")


def make_window():
    """What an operator asks of Blender's windows."""
    notes: list = []
    window = SimpleNamespace(
        progress_begin=lambda *_: notes.append("begin"),
        progress_update=lambda *_: None,
        progress_end=lambda: notes.append("end"),
        event_timer_add=lambda *_, **__: "timer",
        event_timer_remove=notes.append,
        modal_handler_add=lambda _: notes.append("handler"),
    )
    return window, notes


def start_modal(mode: str):
    """Begin a clean-up as the interface does."""
    use(mode)
    operators = stage.module("operators")
    window, notes = make_window()
    told: list = []
    context = SimpleNamespace(
        window_manager=window,
        window=None,
        workspace=SimpleNamespace(status_text_set=notes.append),
        screen=None,
        scene=bpy.context.scene,
        object=bpy.context.object,
        preferences=bpy.context.preferences,
    )

    class Pressed(operators.JobOperator):
        """The operator without Blender's class, which only Blender makes."""

        anchor = False
        prepare = operators.MAPCTL_OT_clean_up.prepare

        def report(self, kind, text):
            told.append((sorted(kind), text))

    pressed = Pressed()
    assert pressed.start(context) == {"RUNNING_MODAL"}
    return pressed, context, notes, told


def play_modal() -> None:
    """The operator in the interface: it goes on by a timer, ends by Esc or by itself."""
    clear()
    armature = armatures.add_mixamo()
    animate(armature)
    armatures.select(armature)
    bpy.context.scene.frame_set(1)
    before = state()
    pressed, context, notes, told = start_modal("sleep")
    timer, escape, key = (SimpleNamespace(type=kind) for kind in ("TIMER", "ESC", "A"))
    process = stage.FOLDER / "process.txt"
    seen = set()
    facts["poll while one runs"] = bpy.ops.mapctl.clean_up.poll()
    while "walking 25 %" not in seen:
        assert pressed.modal(context, timer) == {"RUNNING_MODAL"}
        seen.add(stage.module("operators").Report.step.describe())
        stage.module("operators").time.sleep(0.02)
    facts["steps"] = sorted(seen)
    facts["panel while it runs"] = draw_panel()
    facts["keys are held"] = sorted(pressed.modal(context, key))
    facts["view is free"] = sorted(pressed.modal(context, SimpleNamespace(type="WHEELUPMOUSE")))
    assert pressed.modal(context, escape) == {"CANCELLED"}
    number, folder = process.read_text().split("\n")
    facts["cancelled"] = {
        "ended": not is_running(int(number)),
        "folder": Path(folder).exists(),
        "unchanged": state() == before,
        "notes": [note for note in notes if note in ("begin", "end", "timer", "handler", None)],
        "told": stage.told(),
        "step": stage.module("operators").Report.step is None,
    }
    pressed, context, notes, told = start_modal("echo")
    answer = {"RUNNING_MODAL"}
    while answer == {"RUNNING_MODAL"}:
        answer = pressed.modal(context, timer)
    facts["modal end"] = [sorted(answer), told, notes[-3:]]
    pressed, context, notes, told = start_modal("fail")
    answer = {"RUNNING_MODAL"}
    while answer == {"RUNNING_MODAL"}:
        answer = pressed.modal(context, timer)
    facts["modal failure"] = [sorted(answer), told]
    facts["panel after a failure"] = draw_panel()


def is_running(number: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return True


class Layout:
    """What a panel asks of Blender's layout; what it draws is noted."""

    def __init__(self, drawn: list):
        self.drawn = drawn

    def box(self):
        return self

    def column(self, align=False):
        return self

    def label(self, text, icon=""):
        self.drawn.append(text)

    def prop(self, options, name):
        assert name in options.bl_rna.properties
        self.drawn.append(name)

    def operator(self, name):
        self.drawn.append(name)
        group, own = name.split(".")
        kind = getattr(getattr(bpy.ops, group), own).get_rna_type()
        return SimpleNamespace(**dict.fromkeys(kind.properties.keys()))


def draw_panel() -> list[str]:
    """What the panel shows now."""
    drawn: list[str] = []
    panel = stage.module("panel").MAPCTL_PT_sidebar
    standing = SimpleNamespace(layout=Layout(drawn))
    for name in ("_draw_job", "_draw_report"):
        setattr(standing, name, getattr(panel, name).__get__(standing))
    panel.draw(standing, bpy.context)
    return drawn


def check_manifest() -> str:
    """What Blender's own tool says of the zip."""
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    command = [sys.executable, str(tool), "validate", str(stage.FOLDER / "addon.zip")]
    return subprocess.run(command, capture_output=True, text=True).stdout


def play_settings() -> None:
    """Options are the scene's, and the gap is taken from the preview range; the add-on goes and comes."""
    scene = bpy.context.scene
    scene.use_preview_range, scene.frame_preview_start, scene.frame_preview_end = True, 20, 31
    bpy.ops.mapctl.preview_gap()
    facts["gap"] = [scene.mapctl.gap.first, scene.mapctl.gap.last]
    facts["panel"] = draw_panel()
    bpy.ops.preferences.addon_disable(module=stage.ADDON)
    facts["manifest"] = check_manifest()
    facts["gone"] = not hasattr(bpy.types.Scene, "mapctl")
    bpy.ops.preferences.addon_enable(module=stage.ADDON)
    facts["back"] = hasattr(bpy.types.Scene, "mapctl")


stage.install()
for play in (play_echoes, play_walks, play_errors, play_selection, play_modal, play_generated, play_settings):
    play()
stage.finish(facts)
