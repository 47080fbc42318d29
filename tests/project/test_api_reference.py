"""The reference: each public name has one entry, a docstring with units and shapes, and an example or a link to one."""

import ast
import inspect
import re
from dataclasses import dataclass
from functools import cache
from importlib import import_module

import pages
import public_api
import pytest
from public_api import Documented, find_unstated, is_number
from public_names import PUBLIC

PACKAGES = ("mapctl", "priors", "controllers", "scenes")
REFERENCE = [page for page in pages.PAGES if page.startswith("docs/reference/api/")]
ENTRY = re.compile(r"^\.\. auto(?P<kind>\w+):: (?P<name>\S+)\n(?P<body>(?:[ ]{3}.*\n|\n)*)", re.MULTILINE)
DOCUMENTED = {one.path: one for one in public_api.list_documented()}


@dataclass(frozen=True)
class Entry:
    """An entry of the reference."""

    page: str
    name: str
    kind: str
    """What autodoc is told it is: module, function, class, exception, data."""
    body: str
    """Options and what stands below the docstring."""

    @property
    def documents(self) -> list[str]:
        """Pages that it links to, as files."""
        return [f"docs/{target}.md" for target in re.findall(r":doc:`/([^`]+)`", self.body)]

    @property
    def others(self) -> list[str]:
        """Entries that it links to."""
        return re.findall(r":py:obj:`([^`]+)`", self.body)


@cache
def read_entries() -> list[Entry]:
    """All of them, page by page."""
    return [
        Entry(page, found["name"], found["kind"], found["body"])
        for page in REFERENCE
        for found in ENTRY.finditer(pages.read_page(page))
    ]


@cache
def read_code(page: str) -> str:
    """What a page shows as code."""
    return "\n".join(re.findall(r"^```.*?^```|`[^`\n]+`", pages.read_page(page), re.DOTALL | re.MULTILINE))


def mentions(text: str, name: str) -> bool:
    """Whether a text has the last part of a dotted name."""
    return re.search(rf"(?<![\w-]){name.rpartition('.')[2]}(?![\w-])", text) is not None


def source_of(name: str) -> str:
    """The source of an entry; of a value that of its module."""
    thing = public_api.public_objects()[name]
    coded = inspect.isclass(thing) or inspect.isfunction(thing)
    return inspect.getsource(inspect.unwrap(thing) if coded else import_module(name.rpartition(".")[0]))


def test_every_public_name_has_one_entry_and_every_entry_is_public():
    things = {name for name, thing in public_api.public_objects().items() if not inspect.ismodule(thing)}
    assert sorted(entry.name for entry in read_entries()) == sorted([*PUBLIC, *things])


def test_entries_are_of_the_kind_that_they_say():
    for entry in read_entries():
        if entry.kind != "module":
            thing = public_api.public_objects()[entry.name]
            kind = "class" if inspect.isclass(thing) else "function" if callable(thing) else "data"
            assert {"exception": "class"}.get(entry.kind, entry.kind) == kind or entry.kind == "data", entry.name


def test_classes_show_their_members():
    hidden = {entry.name for entry in read_entries() if entry.kind == "class" and ":members:" not in entry.body}
    assert [path for path in DOCUMENTED if path.rpartition(".")[0] in hidden and not path.endswith("__call__")] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_completion_shows_what_is_public(package):
    module = import_module(package)
    assert {*dir(module)} - {"__version__"} == {*PUBLIC[package]}
    assert {*module.__all__} == {*dir(module)}


def test_modules_that_list_their_names_list_those():
    for name, module in public_api.public_modules().items():
        assert {*PUBLIC[name]} <= {*getattr(module, "__all__", PUBLIC[name])}


def imported_names(code: str) -> set[str]:
    """Dotted names of the packages that code imports from them."""
    nodes = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    return {
        f"{node.module}.{each.name}" for node in nodes for each in node.names if node.module.split(".")[0] in PACKAGES
    }


def test_what_pages_import_is_public():
    public = [*public_api.public_objects().values(), *public_api.public_modules().values()]
    for page in pages.PAGES:
        for name in set().union(*(imported_names(block.text) for block in pages.blocks(page, "python"))):
            module, _, own = name.rpartition(".")
            thing = getattr(import_module(module), own)
            assert any(thing is each for each in public), f"{page}: {name}"


def test_every_entry_has_an_example_or_leads_to_one():
    """Its own page uses it in code, or a linked page does, or a linked entry takes it, returns it, or is made of it."""
    for entry in read_entries():
        if entry.kind == "module":
            continue
        examples = "\n".join(block.text for block in pages.blocks(entry.page, "python"))
        linked = [read_code(page) for page in entry.documents] + [source_of(name) for name in entry.others]
        assert any(mentions(text, entry.name) for text in (examples, *linked)), entry.name


def test_every_link_leads_somewhere():
    for entry in read_entries():
        assert {*entry.documents} <= {*pages.PAGES}, entry.name
        assert {*entry.others} <= public_api.public_objects().keys(), entry.name
        for text in [*map(read_code, entry.documents), *map(source_of, entry.others)]:
            assert mentions(text, entry.name), f"{entry.name}: a page or an entry that it links to does not name it"


@pytest.mark.parametrize("name", PUBLIC)
def test_modules_say_what_they_are_for(name):
    assert import_module(name).__doc__


def test_everything_public_has_a_docstring_that_stands_alone():
    assert [path for path, one in DOCUMENTED.items() if not one.docstring or one.docstring.startswith("See ")] == []


def test_numbers_state_their_unit_and_tensors_their_shape():
    assert {path: unstated for path, one in DOCUMENTED.items() if (unstated := find_unstated(one))} == {}


def test_a_unit_that_is_missing_is_seen():
    assert find_unstated(Documented("f", "Walk so fast.", ("speed",))) == ["speed"]
    assert find_unstated(Documented("f", "Walk at a `speed`. Metres are metres.", ("speed",))) == ["speed"]
    assert find_unstated(Documented("f", "Walk at a `speed` in m/s.", ("speed",))) == []
    assert find_unstated(Documented("f", "Wait.", ("seconds", "most_frames"))) == []
    assert find_unstated(Documented("C.sigma", "How sure it is.", ("sigma",), is_field=True)) == ["sigma"]
    assert find_unstated(Documented("C.sigma", "How sure it is, radians.", ("sigma",), is_field=True)) == []
    assert find_unstated(Documented("f", "Return how far.", returns_number=True)) == ["return"]


def test_numbers_are_recognised_in_what_holds_them():
    import torch
    from jaxtyping import Float

    assert all(map(is_number, (int, float | None, tuple[float, float], dict[str, int], torch.Tensor, "float | None")))
    assert not any(map(is_number, (bool, str, Float[torch.Tensor, "frames 3"], "Float[Tensor, '3']", "Motion")))
