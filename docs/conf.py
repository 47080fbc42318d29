"""How Sphinx builds the site: `make docs`."""

import sys
from pathlib import Path

from mapctl import __version__

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "mapctl"
author = "The mapctl authors"
copyright = "2026, the mapctl authors; MIT"
version = release = __version__

extensions = [
    "command_options",
    "readable_signatures",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build"]

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
