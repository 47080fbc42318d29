"""The operators in the interface: by a timer, Esc, the panel, the options; mapctl itself is a stub.

python play_interface.py FOLDER PYTHON
"""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import armatures
import blender_stage
import bpy

facts: dict = {}


def make_window():
    """Stub of Blender's window manager."""
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
    blender_stage.use(mode)
    operators = blender_stage.module("interface")
    window, notes = make_window()
    printed: list = []
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
            printed.append((sorted(kind), text))

    pressed = Pressed()
    assert pressed.start(context) == {"RUNNING_MODAL"}
    return pressed, context, notes, printed


def play_modal() -> None:
    """The operator in the interface: it goes on by a timer, ends by Esc or by itself."""
    blender_stage.clear()
    armature = armatures.add_mixamo()
    armatures.animate(armature)
    armatures.select(armature)
    bpy.context.scene.frame_set(1)
    before = blender_stage.state()
    pressed, context, notes, printed = start_modal("sleep")
    timer, escape, key = (SimpleNamespace(type=kind) for kind in ("TIMER", "ESC", "A"))
    process = blender_stage.FOLDER / "process.txt"
    seen = {blender_stage.module("interface").Report.step.describe()}
    facts["poll while one runs"] = bpy.ops.mapctl.clean_up.poll()
    while "walking 25 %" not in seen:
        assert pressed.modal(context, timer) == {"RUNNING_MODAL"}
        seen.add(blender_stage.module("interface").Report.step.describe())
        blender_stage.module("interface").time.sleep(0.02)
    facts["steps"] = sorted(seen)
    facts["panel while it runs"] = draw_panel()
    facts["keys are held"] = sorted(pressed.modal(context, key))
    facts["view is free"] = sorted(pressed.modal(context, SimpleNamespace(type="WHEELUPMOUSE")))
    assert pressed.modal(context, escape) == {"CANCELLED"}
    number, folder = process.read_text().split("\n")
    facts["cancelled"] = {
        "ended": not is_running(int(number)),
        "folder": Path(folder).exists(),
        "unchanged": blender_stage.state() == before,
        "notes": [note for note in notes if note in ("begin", "end", "timer", "handler", None)],
        "printed": blender_stage.printed(),
        "step": blender_stage.module("interface").Report.step is None,
    }
    pressed, context, notes, printed = start_modal("echo")
    answer = {"RUNNING_MODAL"}
    while answer == {"RUNNING_MODAL"}:
        answer = pressed.modal(context, timer)
    facts["modal end"] = [sorted(answer), printed, notes[-3:]]
    pressed, context, notes, printed = start_modal("fail")
    answer = {"RUNNING_MODAL"}
    while answer == {"RUNNING_MODAL"}:
        answer = pressed.modal(context, timer)
    facts["modal failure"] = [sorted(answer), printed]


def is_running(number: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return True


class Layout:
    """Stub of Blender's layout that notes what is drawn."""

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
    """Return the text of the panel."""
    drawn: list[str] = []
    panel = blender_stage.module("interface").MAPCTL_PT_sidebar
    standing = SimpleNamespace(layout=Layout(drawn))
    standing._draw_report = panel._draw_report.__get__(standing)
    panel.draw(standing, bpy.context)
    return drawn


def check_manifest() -> str:
    """Validate the zip by Blender's own tool."""
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    command = [sys.executable, str(tool), "validate", str(blender_stage.FOLDER / "addon.zip")]
    return subprocess.run(command, capture_output=True, text=True).stdout


def play_settings() -> None:
    """Options are the scene's; the add-on goes and comes."""
    facts["panel"] = draw_panel()
    bpy.ops.preferences.addon_disable(module=blender_stage.ADDON)
    facts["manifest"] = check_manifest()
    facts["gone"] = not hasattr(bpy.types.Scene, "mapctl")
    bpy.ops.preferences.addon_enable(module=blender_stage.ADDON)
    facts["back"] = hasattr(bpy.types.Scene, "mapctl")


blender_stage.install()
play_modal()
play_settings()
blender_stage.finish(facts)
