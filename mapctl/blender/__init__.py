"""The Blender add-on: its source in `addon`, and the zip that Blender installs."""
