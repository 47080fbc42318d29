"""The panel `mapctl` in the sidebar of the 3D view."""

import textwrap

import bpy

from .operators import MAPCTL_OT_clean_up, MAPCTL_OT_fill_gap, MAPCTL_OT_in_between, MAPCTL_OT_walk, Report
from .settings import MAPCTL_OT_preview_gap

_WIDTH = 44  # characters of a line of the panel, about


class MAPCTL_PT_sidebar(bpy.types.Panel):
    """All operators with their options, and what happened last."""

    bl_label = "mapctl"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "mapctl"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw it."""
        settings = context.scene.mapctl
        self._draw_job(MAPCTL_OT_walk, settings.walk, ("speed", "seconds", "gait", "style", "seed"))
        self._draw_job(MAPCTL_OT_clean_up, settings.clean_up, ("anchor",))
        self._draw_job(MAPCTL_OT_fill_gap, settings.gap, ("first", "last", "selected"))
        self.layout.operator(MAPCTL_OT_preview_gap.bl_idname)
        self._draw_job(MAPCTL_OT_in_between, None, ())
        self._draw_report()

    def _draw_job(self, operator: type, options: bpy.types.PropertyGroup | None, names: tuple[str, ...]) -> None:
        """Draw the options of an operator and its button, which hands them on."""
        column = self.layout.box().column(align=True)
        for name in names:
            column.prop(options, name)
        button = column.operator(operator.bl_idname)
        for name in names:
            setattr(button, name, getattr(options, name))

    def _draw_report(self) -> None:
        column = self.layout.column(align=True)
        if Report.step is not None:
            column.label(text=Report.step.describe(), icon="TIME")
            column.label(text="Esc to cancel")
            return
        icon = "ERROR" if Report.failed else "INFO"
        for line in Report.lines:
            for number, part in enumerate(textwrap.wrap(line, _WIDTH)):
                column.label(text=part, icon="BLANK1" if number else icon)
