"""All four operators on one armature: walk, shake and clean up, fill a gap, thin to a few keys and in-between them.

python play_jobs.py FOLDER PYTHON KIND MODELS FPS STAGES: the operators are run in turn, so many of the stages.
"""

import sys

import armatures
import blender_stage
import bpy
import numpy as np

KIND, MODELS, FPS, STAGES = sys.argv[3:7]
MAKERS = {
    "imported": lambda: armatures.add_mixamo(imported=True),
    "metarig": armatures.add_metarig,
    "generated": armatures.add_generated,
}
KEYS = (1, 9, 17, 25)
FRAMES = range(1, 26)


def main() -> None:
    """Play, and note what Blender shows after each."""
    blender_stage.install()
    blender_stage.set_command(
        blender_stage.PYTHON, blender_stage.SCRIPTS / "recorder.py", blender_stage.FOLDER / "kept", MODELS
    )
    scene = bpy.context.scene
    scene.render.fps, scene.frame_end = int(FPS), 10
    armature = MAKERS[KIND]()
    drawn = armatures.add_curve(height=0.25)
    armatures.select(armature, drawn)
    scene.frame_set(7)
    facts, arrays = {"version": bpy.app.version[:2], "stages": {}}, {}
    # A little more than the frames that are looked at.
    stages = {
        "walk": lambda: bpy.ops.mapctl.walk(speed=1.1, seconds=26 / int(FPS)),
        "clean": bpy.ops.mapctl.clean_up,
        "filled": lambda: bpy.ops.mapctl.fill_gap(first=10, last=18),
        "tweened": bpy.ops.mapctl.in_between,
        "again": bpy.ops.mapctl.in_between,
    }
    before = {"clean": lambda: armatures.add_noise(armature, 3.0), "tweened": lambda: thin(armature)}
    for name, run in list(stages.items())[: int(STAGES)]:
        before.get(name, lambda: None)()
        joints = names_of(armature)
        arrays[f"{name} before"] = armatures.joints_of(armature, joints, FRAMES) if name != "walk" else np.zeros(0)
        facts["stages"][name] = {"status": list(run()), "printed": blender_stage.printed(), **describe(armature)}
        arrays[name] = armatures.joints_of(armature, joints, range(1, 1 + count(armature)))
    facts |= {"joints": joints, "frame": scene.frame_current, "end": scene.frame_end}
    facts["actions"] = [(each.name, each.use_fake_user) for each in bpy.data.actions]
    facts["switches"] = [bone["IK_FK"] for bone in armature.pose.bones if "IK_FK" in bone]
    facts["left behind"] = [len(bpy.data.curves), len(bpy.data.objects) - len(bpy.context.scene.objects)]
    blender_stage.finish(facts, arrays)


def names_of(armature) -> list[str]:
    """Bones whose heads are the joints that mapctl gets."""
    if "generated" not in KIND:
        return [bone.name for bone in armature.data.bones]
    head = "DEF-spine.006"
    trunk = [f"DEF-spine{end}" for end in ("", ".001", ".002", ".003", ".004")]
    limbs = ("shoulder", "upper_arm", "forearm", "hand", "thigh", "shin", "foot", "toe")
    return [*trunk, head, *(f"DEF-{limb}.{side}" for limb in limbs for side in "LR")]


def count(armature) -> int:
    """Frames of its action."""
    return int(armature.animation_data.action.frame_range[1])


def thin(armature) -> None:
    """Leave only a few keys, all of them one's own."""
    for curve in armatures.curves_of(armature):
        if "IK_FK" in curve.data_path:
            continue
        for key in reversed(list(curve.keyframe_points)):
            if round(key.co[0]) in KEYS:
                key.type = "KEYFRAME"
            else:
                curve.keyframe_points.remove(key)
        curve.update()


def describe(armature) -> dict:
    """Describe its action: its name, the greatest step of curves by kind, keyed bones, kinds of keys."""
    curves = armatures.curves_of(armature)
    steps: dict[str, float] = {}
    for curve in curves:
        kind = curve.data_path.rpartition(".")[2]
        steps[kind] = max(armatures.largest_step(curve), steps.get(kind, 0.0))
    turned = next(curve for curve in curves if "rotation" in curve.data_path)
    own = [round(key.co[0]) for key in turned.keyframe_points if key.type == "KEYFRAME"]
    placed = {curve.data_path.split('"')[1] for curve in curves if curve.data_path.endswith("location")}
    return {
        "action": armature.animation_data.action.name,
        "steps": steps,
        "own keys": own,
        "placed": sorted(placed),
        "bones": sorted({curve.data_path.split('"')[1] for curve in curves}),
        "linear": all(key.interpolation == "LINEAR" for key in turned.keyframe_points),
    }


main()
