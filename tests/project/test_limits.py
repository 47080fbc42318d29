"""How far the code is from its own limits: no count may rise, and whoever lowers one lowers its ceiling here."""

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from source_files import FILES, PACKAGE_FILES, ROOT, absolute, imports, tree_of

from mapctl import terms

COMMANDS = Path("mapctl/commands")
MAX_MODULES = 14  # in a folder, beside its __init__
MODELS = re.compile("prior|densit|rollable|extending|infiller|refiner|denoiser|inbetweener|proposer")
MAY_ADVANCE = ("mapctl/problem/receding_horizon.py", "priors/lstm_gmm/", "priors/training/")
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def nodes(*kinds: type) -> Iterator[tuple[str, ast.AST]]:
    """Of these kinds in every file of the packages, each with its place."""
    for file in PACKAGE_FILES:
        for node in ast.walk(tree_of(file)):
            if isinstance(node, kinds):
                yield f"{file}:{getattr(node, 'lineno', 1)}", node


def docstrings() -> Iterator[tuple[str, str]]:
    """Every one with its place."""
    for place, node in nodes(ast.Module, ast.ClassDef, *FUNCTIONS):
        yield place, ast.get_docstring(node) or ""  # pyright: ignore[reportArgumentType]


def late_imports() -> Iterable[str]:
    """Imports inside functions, but for the command line's."""
    found = {
        f"{place.split(':')[0]}:{inner.lineno}"
        for place, node in nodes(*FUNCTIONS)
        for inner in ast.walk(node)
        if isinstance(inner, ast.Import | ast.ImportFrom) and not Path(place).is_relative_to(COMMANDS)
    }
    return sorted(found)


def module_name(file: Path) -> str:
    """As it is imported."""
    return ".".join(file.with_suffix("").parts).removesuffix(".__init__")


def imported_modules(file: Path, tree: ast.Module, known: set[str]) -> set[str]:
    """Which of the known modules a file names, late or for type checkers too."""
    found = imports(file, tree)
    for node in ast.walk(tree):  # `from package import module` names the module, not what the package holds
        if isinstance(node, ast.ImportFrom):
            base = absolute(file, node)
            if {f"{base}.{alias.name}" for alias in node.names} <= known:
                found.discard(base)
    return found & known


def cycles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected modules, by two and more."""
    names = sorted(edges)
    number = {name: place for place, name in enumerate(names)}
    pairs = np.array([(number[a], number[b]) for a in names for b in edges[a] if a != b]).reshape(-1, 2)
    graph = csr_array((np.ones(len(pairs)), pairs.T), shape=(len(names), len(names)))
    _, label = connected_components(graph, connection="strong")
    parts = [[name for name, mine in zip(names, label, strict=True) if mine == part] for part in set(label)]
    return [part for part in parts if len(part) > 1]


def modules_in_cycles() -> Iterable[str]:
    """Modules that import themselves by way of others."""
    known = {module_name(file) for file in PACKAGE_FILES}
    edges = {module_name(file): imported_modules(file, tree_of(file), known) for file in PACKAGE_FILES}
    return [f"{name} ({len(part)} together)" for part in cycles(edges) for name in part]


def docstrings_that_begin_with_of() -> Iterable[str]:
    """What they describe does not stand in them."""
    return [place for place, text in docstrings() if text.startswith("Of ")]


def docstrings_that_cite_what_is_not_here() -> Iterable[str]:
    """A design document is not in the repository."""
    return [place for place, text in docstrings() if re.search(r"\b[Tt]he design\b|DESIGN", text)]


def models_of_any_type() -> Iterable[str]:
    """Parameters for a model that no protocol describes."""
    return [
        f"{place} {node.arg}"
        for place, node in nodes(ast.arg)
        if isinstance(node, ast.arg)
        and node.annotation is not None
        and MODELS.search(node.arg)
        and re.fullmatch(r"(Sequence\[|list\[)?Any\]?( \| None)?", ast.unparse(node.annotation))
    ]


def advances_elsewhere() -> Iterable[str]:
    """A model's state moves on in one place of a solve."""
    return [
        f"{file}:{line}"
        for file in PACKAGE_FILES
        if not str(file).startswith(MAY_ADVANCE)
        for line in advances(tree_of(file))
    ]


def advances(tree: ast.Module) -> list[int]:
    """Lines that move a model's state on.

    Two kinds do not: a method `advance` that hands the call on (whoever called it is counted), and a model that calls
    its own in `sample`, as the protocol's default does: drawing frames returns the state after them, no solve is going
    on, and the caller's state stays as it was.
    """
    parts = {node: name for name in ("advance", "sample") for node in inside(tree, name)}
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr == "advance"
        if parts.get(node) != "advance" and not (parts.get(node) == "sample" and ast.unparse(node.value) == "self")
    ]


def inside(tree: ast.Module, name: str) -> Iterator[ast.AST]:
    """Everything in methods of this name."""
    for kind in ast.walk(tree):
        for method in kind.body if isinstance(kind, ast.ClassDef) else ():
            if isinstance(method, FUNCTIONS) and method.name == name:
                yield from ast.walk(method)


def shortest_arcs_of_their_own() -> Iterable[str]:
    """Functions for the shortest arc between two vectors, but for the one in mapctl.rotations."""
    return [
        f"{place} {node.name}"
        for place, node in nodes(*FUNCTIONS)
        if isinstance(node, ast.FunctionDef) and re.match("_?shortest", node.name)
    ]


def terms_without_a_controller() -> Iterable[str]:
    """Terms of the library that no job asks for."""
    text = "\n".join((ROOT / file).read_text("utf-8") for file in PACKAGE_FILES if file.parts[0] == "controllers")
    return [term.__name__ for term in terms.ALL if not re.search(rf"\b{term.__name__}\b", text)]


def lines_out_of_format() -> Iterable[str]:
    """Lines that the formatter leaves alone."""
    mark = "# fmt: " + "skip"
    return [str(file) for file in FILES for line in (ROOT / file).read_text("utf-8").splitlines() if mark in line]


CEILINGS = {
    late_imports: 10,
    modules_in_cycles: 0,
    docstrings_that_begin_with_of: 0,
    docstrings_that_cite_what_is_not_here: 0,
    models_of_any_type: 0,
    advances_elsewhere: 0,
    shortest_arcs_of_their_own: 0,
    terms_without_a_controller: 0,
    lines_out_of_format: 0,
}


@pytest.mark.parametrize("measure", CEILINGS, ids=lambda measure: measure.__name__)
def test_no_count_is_over_its_ceiling(measure):
    found = list(measure())
    assert len(found) <= CEILINGS[measure], "\n".join(found)


def test_cycles_are_seen_whichever_way_round():
    edges = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a", "d"}}
    assert cycles(edges) == [["b", "c"]]


def test_late_and_typing_imports_make_a_cycle_too():
    known = {"mapctl.motion", "mapctl.formats", "mapctl.formats.bvh"}
    late = ast.parse("if TYPE_CHECKING:\n    from mapctl.motion import Motion\ndef f():\n    import mapctl.formats")
    assert imported_modules(Path("mapctl/formats/bvh.py"), late, known) == {"mapctl.motion", "mapctl.formats"}
    module = ast.parse("from mapctl.formats import bvh")
    assert imported_modules(Path("mapctl/motion.py"), module, known) == {"mapctl.formats.bvh"}


@pytest.mark.parametrize(
    ("source", "lines"),
    [
        ("def solve(prior, state): return prior.advance(state, 0)", [1]),
        ("def advance(prior, state): return prior.advance(state, 0)", [1]),
        ("class Solver:\n  def solve(self): self.density.advance(0, 0)", [2]),
        ("class Solver:\n  def solve(self): self.advance(0, 0)", [2]),
        ("class Prior:\n  def sample(self): self.advance(0, 0)", []),
        ("class Solver:\n  def sample(self): self.density.advance(0, 0)", [2]),
        ("class Prior:\n  def advance(self): return self.density.advance(0, 0)", []),
    ],
)
def test_what_moves_a_state_on_is_seen_and_what_hands_it_on_is_not(source, lines):
    assert advances(ast.parse(source)) == lines
