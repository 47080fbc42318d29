"""mapctl in Blender: walk along curves, clean up captures, fill gaps, in-between keys.

Blender imports this package from the zip that `mapctl blender-addon` makes. It needs bpy, numpy and the standard
library; mapctl itself runs as a process of its own.
"""

import bpy

from . import interface


def register() -> None:
    """Add all classes, and the options that scenes keep."""
    for each in interface.CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.mapctl = bpy.props.PointerProperty(type=interface.MAPCTL_PG_settings)


def unregister() -> None:
    """Take all that away again."""
    del bpy.types.Scene.mapctl
    for each in reversed(interface.CLASSES):
        bpy.utils.unregister_class(each)
