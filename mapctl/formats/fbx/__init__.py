"""FBX in, by the package ufbx: characters and captures, as rigs and as clips. FBX is not written."""

from mapctl.formats.fbx.reader import load, load_mesh, load_rest

__all__ = ["load", "load_mesh", "load_rest"]
