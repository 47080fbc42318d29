"""How Sphinx builds the site: `make docs`."""

import dataclasses
import re
import sys
from pathlib import Path

from docutils import nodes
from sphinx import addnodes

from mapctl import __version__

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "mapctl"
author = "The mapctl authors"
copyright = "2026, the mapctl authors; MIT"
version = release = __version__

extensions = [
    "command_options",
    "followed_tutorials",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "gallery"]  # the scripts become pages in auto_gallery

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    # Every script runs at every build: those that use the library rot with it, whether they have changed or not.
    "filename_pattern": "",
    "run_stale_examples": True,
    "within_subsection_order": "example_gallery.ReadingOrder",
    "image_scrapers": ("example_gallery.show_pictures", "matplotlib"),
    "reset_modules": ("matplotlib", "example_gallery.tidy_up"),
    "reset_modules_order": "both",
    "thumbnail_size": (320, 180),
    "capture_repr": (),
    # Scripts are there to be read and downloaded; the rest is clutter.
    "download_all_examples": False,
    "notebook_extensions": set(),
    "min_reported_time": 3600,
    "write_computation_times": False,
    "show_signature": False,
}

myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 4

default_role = "code"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
autoclass_content = "both"
maximum_signature_line_length = 100

html_theme = "furo"
html_title = "mapctl"
html_static_path = ["static"]
html_css_files = ["gallery.css"]


def shorten_signature(app, what, name, obj, options, signature, returned):
    """Show the names of a dataclass's fields, whose types and defaults stand below; a protocol is not called."""
    if what == "class" and getattr(obj, "_is_protocol", False):
        return "", returned
    if what == "class" and dataclasses.is_dataclass(obj):
        names = [each.name for each in dataclasses.fields(obj) if each.init and not each.name.startswith("_")]
        return f"({', '.join(names)})", returned
    return signature, returned


def strip_bounds(app, tree):
    """Show a bounded number's type without pydantic's description of the bounds."""
    for node in list(tree.findall(addnodes.desc_annotation)):
        text = re.sub(r"Annotated\[(.+?), FieldInfo\(.*?metadata=\[.*?\]\)\]", r"\1", node.astext())
        if text != node.astext():
            node.children = [nodes.Text(text)]


def setup(app):
    """Connect to autodoc."""
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("doctree-read", strip_bounds)
