"""The project's own source files, parsed: what the tests of its shape look at."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# `mapctl` is the core; the other three know it and never each other.
MAY_IMPORT = {
    "mapctl": {"mapctl"},
    "priors": {"priors", "mapctl"},
    "controllers": {"controllers", "mapctl"},
    "scenes": {"scenes", "mapctl"},
}
FOLDERS = (*MAY_IMPORT, "tests")
FILES = sorted(file.relative_to(ROOT) for folder in FOLDERS for file in (ROOT / folder).rglob("*.py"))
PACKAGE_FILES = [file for file in FILES if file.parts[0] in MAY_IMPORT]
LATE_IMPORTERS = {"import_module", "__import__", "find_spec"}


@cache
def tree_of(file: Path) -> ast.Module:
    """Parsed, by its path within the project."""
    return ast.parse((ROOT / file).read_text("utf-8"), str(file))


def absolute(file: Path, node: ast.ImportFrom) -> str:
    """The module a `from` import names, dots resolved."""
    if not node.level:
        return node.module or ""
    package = file.with_suffix("").parts[: -node.level]
    return ".".join([*package, *filter(None, [node.module])])


def called_name(node: ast.Call) -> str:
    """Without what it is an attribute of."""
    return ast.unparse(node.func).rpartition(".")[2]


def imports(file: Path, tree: ast.Module) -> set[str]:
    """Every dotted name the file imports, at its top or late, by statement or by name."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = absolute(file, node)
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and called_name(node) in LATE_IMPORTERS:
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)}
    return found
