"""glTF 2.0, VRM and VRM animations: characters in, and motions out, on their own character or on a mannequin."""

from mapctl.formats.gltf.reader import load, load_mesh, load_rest
from mapctl.formats.gltf.writer import save

__all__ = ["load", "load_mesh", "load_rest", "save"]
