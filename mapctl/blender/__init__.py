"""The Blender add-on: its source in `addon`, and the zip that Blender installs; and the script by which Blender writes
FBX."""

from pathlib import Path

WRITE_FBX = str(Path(__file__).with_name("write_fbx.py"))
"""The script."""
