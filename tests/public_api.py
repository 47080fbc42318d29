"""What the reference must say of the public names, and where a name's documentation falls short of it.

A number's unit is stated where one of these holds: its annotation tells a shape (jaxtyping); its name has a word of
UNIT_NAMES; or its own docstring, or a sentence of the function's that names it, has a unit (UNITS) or a shape, (n, 3).
"""

import ast
import dataclasses
import inspect
import re
import typing
from collections.abc import Callable, Iterator
from enum import Enum
from fractions import Fraction
from functools import cache, cached_property
from importlib import import_module
from types import ModuleType

import numpy as np
import torch
from jaxtyping import AbstractArray
from public_names import PUBLIC

UNIT_NAMES = {"cm", "count", "deg", "fps", "frame", "frames", "mb", "metres", "ms", "seconds", "seed"}
UNITS = re.compile(
    r"\b(metres?|centimetres?|cm|m/s|radians?|rad/s|degrees?|seconds?|s|milliseconds|hz|frames?|fps|pixels?|bytes?|mb"
    r"|nats?|evaluations?|iterations?|units?|share|shares|percentile|factor|ratio|number|numbers|index|indices|xyzw"
    r"|how many|0 to 1)\b|/s\b|\((\w+, )+\w+\)",
    re.IGNORECASE,
)
_NUMBERS = (int, float, Fraction, torch.Tensor, np.ndarray)


@dataclasses.dataclass(frozen=True)
class Documented:
    """A function, method, property, field or class with what is said of it."""

    path: str
    """Dotted name."""
    docstring: str
    """What is said of it; empty where nothing is."""
    numbers: tuple[str, ...] = ()
    """Parameters that are numbers or tensors without a shape; for a field its own name."""
    returns_number: bool = False
    """Whether it returns numbers without a shape."""
    is_field: bool = False
    """Whether the docstring is about the one number."""


def public_modules() -> dict[str, ModuleType]:
    """The modules of the table by name."""
    return {name: import_module(name) for name in PUBLIC}


def public_objects() -> dict[str, object]:
    """What the names of the table stand for."""
    return {f"{name}.{own}": getattr(module, own) for name, module in public_modules().items() for own in PUBLIC[name]}


def list_documented() -> Iterator[Documented]:
    """Everything public that is to be documented, members of classes too."""
    for path, thing in public_objects().items():
        if inspect.isclass(thing):
            yield from _list_members(path, thing)
        elif inspect.isfunction(inspect.unwrap(thing)) if callable(thing) else False:
            yield _describe(path, inspect.unwrap(thing))
        elif not inspect.ismodule(thing):
            yield Documented(path, _read_value(path, thing))


def find_unstated(one: Documented) -> list[str]:
    """The numbers of it whose unit or shape is stated nowhere; `return` is what it returns."""
    if one.is_field:
        unstated = [name for name in one.numbers if not (_has_unit_name(name) or UNITS.search(one.docstring))]
    else:
        unstated = [name for name in one.numbers if not (_has_unit_name(name) or _is_told(name, one.docstring))]
    silent = one.returns_number and not UNITS.search(one.docstring) and not _has_unit_name(one.path.rpartition(".")[2])
    return [*unstated, "return"] if silent else unstated


def is_number(annotation: object) -> bool:
    """Whether it is, or holds, numbers or tensors of which it tells no shape; what a callable takes does not count."""
    if isinstance(annotation, str):
        return bool(re.search(r"\b(int|float|Tensor|ndarray)\b", annotation)) and "[Tensor" not in annotation
    parts = [*_parts(annotation)]
    if any(inspect.isclass(part) and issubclass(part, AbstractArray) for part in parts):
        return False
    return any(part in _NUMBERS for part in parts if inspect.isclass(part))


def _parts(annotation: object) -> Iterator[object]:
    yield annotation
    if typing.get_origin(annotation) not in (Callable, typing.Literal):
        for part in typing.get_args(annotation):
            yield from _parts(part)


def _has_unit_name(name: str) -> bool:
    return bool(UNIT_NAMES & {*name.split("_")})


def _is_told(name: str, docstring: str) -> bool:
    sentences = re.split(r"(?<=\.)\s+|\n\s*\n", docstring)
    return any(re.search(rf"\b{name}\b", each) and UNITS.search(each.replace(name, "")) for each in sentences)


def _list_members(path: str, cls: type) -> Iterator[Documented]:
    fields, own = _read_fields(cls), vars(cls)
    is_data = "__dataclass_fields__" in own or hasattr(cls, "_fields")
    takes = [] if is_data or "__init__" not in own else _list_numbers(cls.__init__)
    started = inspect.getdoc(cls.__init__) if takes else ""
    yield Documented(path, "\n\n".join(filter(None, [cls.__doc__, started])), tuple(takes))
    for name, annotation in own.get("__annotations__", {}).items():
        if not name.startswith("_") and typing.get_origin(annotation) is not typing.ClassVar:
            numbers = (name,) if is_number(annotation) else ()
            yield Documented(f"{path}.{name}", fields.get(name) or "", numbers, is_field=True)
    for name, member in own.items():
        plain = _unwrap(member)
        if inspect.isfunction(plain) and (name == "__call__" or not name.startswith("_")):
            yield _describe(f"{path}.{name}", plain)
        elif name in fields and not issubclass(cls, Enum) and name not in own.get("__annotations__", {}):
            yield Documented(f"{path}.{name}", fields[name] or "")


def _unwrap(member: object) -> object:
    match member:
        case staticmethod() | classmethod():
            return inspect.unwrap(member.__func__)
        case property():
            return member.fget
        case cached_property():
            return member.func
        case _:
            return inspect.unwrap(member) if callable(member) else member


def _describe(path: str, function: Callable) -> Documented:
    returns = is_number(inspect.signature(function).return_annotation)
    return Documented(path, inspect.getdoc(function) or "", tuple(_list_numbers(function)), returns)


def _list_numbers(function: Callable) -> list[str]:
    parameters = inspect.signature(function).parameters.values()
    return [each.name for each in parameters if each.annotation is not each.empty and is_number(each.annotation)]


@cache
def _tree_of(module: str) -> ast.Module:
    return ast.parse(inspect.getsource(import_module(module)))


def _read_fields(cls: type) -> dict[str, str | None]:
    nodes = [node for node in ast.walk(_tree_of(cls.__module__)) if isinstance(node, ast.ClassDef)]
    return _read_docstrings(next(node for node in nodes if node.name == cls.__name__).body)


def _read_docstrings(body: list[ast.stmt]) -> dict[str, str | None]:
    """The strings that stand behind assignments, by the names that are assigned to; None where there is none."""
    found: dict[str, str | None] = {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
            said = after.value if isinstance(after, ast.Expr) else None
            text = said.value if isinstance(said, ast.Constant) and isinstance(said.value, str) else None
            found |= dict.fromkeys((name for name in names if not name.startswith("__")), text)
    return found


def _read_value(path: str, thing: object) -> str:
    """The docstring of a value, which may come from a module of its package."""
    package, _, name = path.rpartition(".")
    home = getattr(import_module(package), "_HOMES", {}).get(name, package)
    return _read_docstrings(_tree_of(home).body).get(name) or ""
