"""Signatures as they are read: what autodoc makes of dataclasses, protocols, and checked numbers, made short.

A dataclass shows the names of its fields, with defaults that are short: types and meaning of each stand below, a field
an entry. A protocol is not called. `Annotated` types are what they annotate. A name that a package takes from one of
its modules has the docstring that stands there.
"""

import dataclasses
import inspect
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

_LONGEST_DEFAULT = 24  # characters


def format_class_signature(cls: type) -> str | None:
    """Return what stands behind the name of a class; None where autodoc's own is as good."""
    if getattr(cls, "_is_protocol", False):
        return ""
    if issubclass(cls, BaseException):
        return None
    if not dataclasses.is_dataclass(cls) and not hasattr(cls, "_fields"):
        return "()" if str(inspect.signature(cls)) == "(*args, **kwargs)" else None
    return f"({', '.join(_format_parameters(inspect.signature(cls)))})"


def _format_parameters(signature: inspect.Signature) -> Iterator[str]:
    by_name_alone = False
    for each in signature.parameters.values():
        if each.kind is each.KEYWORD_ONLY and not by_name_alone:
            by_name_alone = True
            yield "*"
        if not each.name.startswith("_"):
            yield each.name if each.default is each.empty else f"{each.name}={_format_default(each.default)}"


def _format_default(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_DEFAULT and "<" not in text else "..."


def strip_annotated(text: str) -> str:
    """Return the text of a type without what `Annotated` adds to others."""
    mark = "Annotated["
    while (start := text.find(mark)) >= 0:
        first, depth, comma = start + len(mark), 1, None
        for end in range(first, len(text)):
            depth += {"[": 1, "(": 1, "]": -1, ")": -1}.get(text[end], 0)
            if depth == 1 and text[end] == "," and comma is None:
                comma = end
            if depth == 0:
                text = text[:start] + text[first : comma or end] + text[end + 1 :]
                break
        else:
            break
    return text


def _shorten_class(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    if what not in ("class", "exception") or not inspect.isclass(obj):
        return signature, returned
    short = format_class_signature(obj)
    return (signature if short is None else short), returned


def _mend_docstring(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Leave out what Python says of any named tuple. Take the docstring of a value that a package has from one of its
    modules; autodoc takes that of its type."""
    lines[:] = [line for line in lines if not line.startswith("Create new instance of ")]
    package, _, own = name.rpartition(".")
    if what != "data" or own not in (homes := getattr(import_module(package), "_HOMES", {})):
        return
    found = ModuleAnalyzer.for_module(homes[own]).find_attr_docs().get(("", own))
    if found:
        lines[:] = [*found]


def _leave_out_bases(app: Sphinx, name: str, obj: Any, options: Any, bases: list[type]) -> None:
    """Leave out bases that tell no user anything."""
    bases[:] = [base for base in bases if getattr(base, "__name__", "") not in ("Generic", "LoadedModel", "Protocol")]


def _strip_types(app: Sphinx, tree: nodes.document) -> None:
    for node in list(tree.findall(addnodes.desc_annotation)):
        if "Annotated[" in node.astext():
            node.children = [nodes.Text(strip_annotated(node.astext()))]


def setup(app: Sphinx) -> dict[str, bool]:
    """Listen to autodoc."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-signature", _shorten_class)
    app.connect("autodoc-process-docstring", _mend_docstring)
    app.connect("autodoc-process-bases", _leave_out_bases)
    app.connect("doctree-read", _strip_types)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
