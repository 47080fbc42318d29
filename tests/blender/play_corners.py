"""Difficult armatures, mistakes of users, and undo; mapctl itself is a stub.

python play_corners.py FOLDER PYTHON
"""

import math
import shutil

import armatures
import blender_stage
import bpy
import numpy as np
from mathutils import Matrix

FRAMES = range(1, 13)
facts: dict = {"errors": {}, "apart": {}}
walked: dict = {}


def apart(armature, run, bones: list[str] | None = None) -> float:
    """How far an operator moved the heads of bones, metres."""
    bones = bones or [bone.name for bone in armature.data.bones]
    before = armatures.joints_of(armature, bones, FRAMES)
    assert run() == {"FINISHED"}
    return float(np.abs(armatures.joints_of(armature, bones, FRAMES) - before).max())


def play_echoes() -> None:
    """A motion that comes back unchanged leaves every armature as it was."""
    blender_stage.use("echo")
    blender_stage.clear()
    armature = armatures.add_mixamo(imported=True)
    armatures.animate(armature, positions=("mixamorig:Hips",))
    facts["apart"]["imported"] = apart(armature, bpy.ops.mapctl.clean_up)

    blender_stage.clear()
    armature = armatures.add_mixamo()
    armatures.animate(armature, positions=("mixamorig:Hips",))
    armature.location, armature.rotation_euler = (3, 1, 0.5), (0.1, 0.2, 2.0)
    for frame, position in ((1, (0, 0, 0)), (12, (5, -2, 1))):
        armature.location = position
        armature.keyframe_insert("location", frame=frame)
        armature.pose.bones[0]["mood"] = float(frame)
        armature.pose.bones[0].keyframe_insert('["mood"]', frame=frame)
    facts["apart"]["object that is animated too"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["other curves"] = sorted(
        {c.data_path for c in armatures.curves_of(armature) if "rotation" not in c.data_path}
    )

    blender_stage.clear()
    bpy.context.scene.unit_settings.scale_length = 0.01
    armature = armatures.add_mixamo()
    armature.scale = (100, 100, 100)
    armatures.animate(armature)
    facts["apart"]["scene in centimetres"] = apart(armature, bpy.ops.mapctl.clean_up)
    with np.load(blender_stage.FOLDER / "sent.npz") as sent:
        facts["thigh"] = float(np.linalg.norm(sent["offsets"][sent["names"].tolist().index("mixamorig:LeftLeg")]))

    blender_stage.clear()
    armature = armatures.add_mixamo()
    spine, arm, leg = (armature.data.bones[f"mixamorig:{name}"] for name in ("Spine2", "LeftArm", "LeftUpLeg"))
    spine.use_inherit_rotation = False
    arm.use_local_location = False
    armatures.animate(armature, positions=("mixamorig:LeftUpLeg", "mixamorig:Hips"))
    facts["apart"]["bones that do not follow"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["travelling"] = sorted(
        {c.data_path.split('"')[1] for c in armatures.curves_of(armature) if c.data_path.endswith("location")}
    )
    facts["connected"] = leg.use_connect

    blender_stage.clear()
    armature = armatures.add_mixamo()
    armatures.animate(armature)
    pull = armature.pose.bones["mixamorig:LeftArm"].constraints.new("STRETCH_TO")
    pull.target = bpy.data.objects.new("far", None)
    pull.target.location = (0.8, 0.5, 1.9)
    bpy.context.collection.objects.link(pull.target)
    facts["apart"]["arm that is stretched"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["stretched printed"] = blender_stage.printed()

    clear_and_spin()


def clear_and_spin() -> None:
    """Bones that turn around and around, in each rotation mode."""
    blender_stage.clear()
    armature = armatures.add_mixamo()
    for bone in list(armature.pose.bones)[:4]:
        for frame in FRAMES:
            angle = 0.8 * frame
            if bone.rotation_mode == "QUATERNION":
                bone.rotation_quaternion = (math.cos(angle / 2), 0, math.sin(angle / 2), 0)
            elif bone.rotation_mode == "AXIS_ANGLE":
                bone.rotation_axis_angle = (angle, 0, 1, 0)
            else:
                bone.rotation_euler[1] = angle
            paths = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
            bone.keyframe_insert(paths.get(bone.rotation_mode, "rotation_euler"), frame=frame)
    facts["apart"]["bones that spin"] = apart(armature, bpy.ops.mapctl.clean_up)
    facts["spin"] = [armatures.largest_step(curve) for curve in armatures.curves_of(armature)]


def play_generated() -> None:
    """A generated rig that is animated by its IK controls."""
    blender_stage.use("echo")
    blender_stage.clear()
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
    facts["ended early"] = [end_at("setting the controls", 3), end_at("checking", 0)]
    facts["apart"]["generated rig by IK"] = apart(rig, bpy.ops.mapctl.clean_up, bones)
    facts["generated printed"] = blender_stage.printed()
    facts["turned"] = turn_of(rig, bones)

    facts["stretch is back"] = max(bone.ik_stretch for bone in rig.pose.bones)
    hands = ["DEF-hand.L", "DEF-hand.R", "DEF-foot.L", "DEF-foot.R", "DEF-spine", "DEF-spine.006"]
    rig.animation_data.action = bpy.data.actions["rigAction"]
    facts["apart"]["hands and feet by IK"] = apart(rig, bpy.ops.mapctl.clean_up, hands)


def end_at(label: str, done: int) -> str:
    """End a clean-up at this step; whether all is as it was."""
    armature, jobs, operators = bpy.context.object, blender_stage.module("jobs"), blender_stage.module("interface")
    bpy.context.scene.frame_set(5)
    before, command = blender_stage.state(), blender_stage.module("process").find_command(read_command())
    at = jobs.Scene(bpy.context.scene, armature, command)
    job = jobs.clean_up(at, operators.find_frames(at), anchor=False)
    while (step := next(job)).label != label or step.done < done:
        pass
    changed = blender_stage.state() != before
    job.close()
    return (
        f"{'changed' if changed else 'unchanged'}, then {'as before' if blender_stage.state() == before else 'changed'}"
    )


def read_command() -> str:
    """The preference."""
    return bpy.context.preferences.addons[blender_stage.ADDON].preferences.command


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
    blender_stage.use("echo")
    blender_stage.clear()
    armature, drawn = armatures.add_mixamo(imported=True), armatures.add_curve(cyclic=True, height=0.4)
    holder = bpy.data.objects.new("holder", None)
    bpy.context.collection.objects.link(holder)
    for frame, position in ((1, (0, 0, 0)), (12, (2, 1, 1))):
        holder.location = position
        holder.keyframe_insert("location", frame=frame)
    armature.parent = holder
    armature.pose.bones["mixamorig:LeftUpLeg"].location = (3, 4, 5)
    armature.pose.bones["mixamorig:Spine1"].scale = (1.3, 1.3, 1.3)
    bpy.context.scene.frame_preview_start, bpy.context.scene.use_preview_range = 5, True
    armatures.select(armature, drawn)
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.mapctl.walk("EXEC_DEFAULT", True, speed=1.5, seed=3, style="proud", seconds=2.5) == {"FINISHED"}
    facts["words"] = (blender_stage.FOLDER / "words.txt").read_text().split("\n")
    armature = bpy.data.objects["mixamo"]
    facts["range"] = list(armature.animation_data.action.frame_range)
    root = armatures.joints_of(armature, ["mixamorig:Hips"], range(5, 17))[:, 0]
    facts["root"] = root.tolist()
    walked["imported"] = walked_joints(armature, 5)
    facts["curve"] = (blender_stage.FOLDER / "curve.csv").read_text()
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


def play_generated_walk() -> None:
    """A generated rig that was posed by hand, and walks then."""
    blender_stage.clear()
    rig, drawn = armatures.add_generated(), armatures.add_curve()
    armatures.select(rig, drawn)
    rng = np.random.default_rng(1)
    for name in ("chest", "hips", "spine_fk.001", "tweak_spine.002", "upper_arm_tweak.L", "thigh_ik.L", "torso"):
        rig.pose.bones[name].location = rng.normal(size=3) * 0.1
    bpy.context.view_layer.update()
    facts["walk ended early"] = end_walk_early(drawn)
    assert bpy.ops.mapctl.walk() == {"FINISHED"}
    walked["generated"] = walked_joints(rig, 1)
    drawn.data.splines[0].bezier_points[0].co.z += 0.5
    bpy.context.scene.frame_end = 3
    assert bpy.ops.mapctl.walk() == {"FINISHED"}
    facts["not level"] = [blender_stage.printed()[0], bpy.context.scene.frame_end]


def end_walk_early(drawn) -> str:
    """End a walk while the controls are set; whether all is as it was."""
    jobs, before = blender_stage.module("jobs"), blender_stage.state()
    at = jobs.Scene(bpy.context.scene, bpy.context.object, blender_stage.module("process").find_command(read_command()))
    job = jobs.walk_along(at, drawn, ())
    while (step := next(job)).label != "setting the controls" or step.done < 3:
        pass
    job.close()
    return "as before" if blender_stage.state() == before else "changed"


def walked_joints(armature, first: int) -> np.ndarray:
    """Where Blender shows the joints that mapctl answered with."""
    shutil.copy(blender_stage.FOLDER / "answer.npz", blender_stage.FOLDER / f"{armature.name}.npz")
    with np.load(blender_stage.FOLDER / "answer.npz") as answer:
        return armatures.joints_of(armature, answer["names"].tolist(), range(first, first + 12))


def expect(name: str, run, **options) -> None:
    """Note what the interface reports of an operator that cannot do its work, and that nothing was changed."""
    bpy.context.scene.frame_set(bpy.context.scene.frame_current)
    before = blender_stage.state()
    try:
        facts["errors"][name] = [str(run(**options)), ""]
    except RuntimeError as error:
        printed = blender_stage.printed()[0]
        same = blender_stage.state() == before and blender_stage.module("interface").Report.failed
        facts["errors"][name] = [printed if printed in str(error) else str(error), "unchanged" if same else "changed"]


def play_errors() -> None:
    """Mistakes of users."""
    blender_stage.clear()
    walk, clean_up = bpy.ops.mapctl.walk, bpy.ops.mapctl.clean_up
    armature = armatures.add_mixamo()
    armatures.select(armature)
    blender_stage.set_command("/nowhere/mapctl")
    expect("program that is not there", walk)
    blender_stage.use("old")
    expect("program that is old", walk)
    blender_stage.use("echo")
    expect("no curve", walk)
    expect("no action", clean_up)
    armature.animation_data_create()
    armature.pose.bones[0].keyframe_insert("location", frame=3)
    armature.pose.bones[0].keyframe_insert("location", frame=4)
    expect("keys in every frame", bpy.ops.mapctl.in_between)
    armatures.animate(armature)
    expect("gap that is outside", bpy.ops.mapctl.fill_gap, first=8, last=13)
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
    blender_stage.use("fail")
    expect("mapctl's own", clean_up)
    blender_stage.use("crash")
    expect("mapctl that crashes", clean_up)
    drawn = armatures.add_curve()
    drawn.data.splines.new("POLY")
    armatures.select(armature, drawn)
    blender_stage.use("echo")
    expect("curve of two splines", walk)


def play_selection() -> None:
    """Selected bones alone are filled."""
    blender_stage.use("echo")
    blender_stage.clear()
    armature = armatures.add_mixamo()
    armatures.animate(armature)
    armatures.select(armature)
    bpy.ops.object.mode_set(mode="POSE")
    bpy.ops.pose.select_all(action="DESELECT")
    for name in ("mixamorig:LeftArm", "mixamorig:LeftHand"):
        bone = armature.pose.bones[name]
        (bone if hasattr(bone, "select") else bone.bone).select = True
    assert bpy.ops.mapctl.fill_gap(first=4, last=7, selected=True) == {"FINISHED"}
    facts["gap words"] = (blender_stage.FOLDER / "words.txt").read_text().split("\n")
    bpy.ops.object.mode_set(mode="OBJECT")


blender_stage.install()
for play in (play_echoes, play_walks, play_generated_walk, play_errors, play_selection, play_generated):
    play()
blender_stage.finish(facts, walked)
