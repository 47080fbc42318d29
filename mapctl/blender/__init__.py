"""The Blender add-on, its source in `addon`, whose zip Blender installs; and the script by which Blender writes FBX."""
