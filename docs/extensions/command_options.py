"""Directives that read the commands of mapctl: `command-list`, a table of them, and `command-options`, one's options.

    ```{command-options} train lstm-gmm
    ```

The words name a command and, where it has some, its sub-command, whose description comes first. Options become entries
of Sphinx' `option`, so that other pages can refer to them, and the search finds them.
"""

import argparse
import re
import warnings
from collections.abc import Iterable, Iterator

import tyro
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mapctl.cli import STYLE
from mapctl.commands import COMMANDS, SUBCOMMANDS

_DEFAULT = re.compile(r"\s*\((default: (?P<value>.*)|required)\)\s*$", re.DOTALL)


class MarkdownDirective(SphinxDirective):
    """A directive whose content is written by it, as Markdown that the page's own parser reads."""

    def parse(self, lines: Iterable[str]) -> list[nodes.Node]:
        """Parse lines as if they stood where the directive stands."""
        text, container = "\n".join(lines), nodes.container()
        self.state.nested_parse(StringList(text.splitlines(), source=self.name), self.content_offset, container)
        return container.children


class CommandList(MarkdownDirective):
    """A table of all commands, each a link to the page of its name."""

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        rows = (
            f"| [{name}]({name}.md) | {describe(kind).split('. ')[0].rstrip('.')} |" for name, kind in COMMANDS.items()
        )
        return self.parse(["| command | what it does |", "|---|---|", *rows])


class CommandOptions(MarkdownDirective):
    """The options of a command."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Parse the entries."""
        return self.parse(format_options(self.arguments[0].split()))


def describe(kind: type) -> str:
    """The docstring of a command, in one line."""
    return " ".join((kind.__doc__ or "").split())


def format_options(words: list[str]) -> Iterator[str]:
    """Lines of Markdown: what is typed, then each option with its values, its meaning and its default."""
    if len(words) > 1:
        yield from (describe(find_kind(words)), "")
    parser = find_parser(words)
    name = " ".join(["mapctl", *words])
    actions = sorted(
        (each for each in parser._actions if each.dest != "help"), key=lambda each: bool(each.option_strings)
    )
    required = [_format_usage(each) for each in actions if each.required]
    yield from ("```text", " ".join([name, *required, "[options]"]), "```", "", f"```{{program}} {name}", "```", "")
    for action in actions:
        yield from _format_action(action)


def find_kind(words: list[str]) -> type:
    """The options class of a command or of its sub-command; KeyError where there is none."""
    return COMMANDS[words[0]] if len(words) == 1 else SUBCOMMANDS[words[0]][words[1]]


def find_parser(words: list[str]) -> argparse.ArgumentParser:
    """The parser of a command; KeyError where there is none of these words."""
    with warnings.catch_warnings():
        # There is no other way yet to ask tyro for its options.
        warnings.simplefilter("ignore", DeprecationWarning)
        return tyro.extras.get_parser(find_kind(words), config=STYLE)


def _format_usage(action: argparse.Action) -> str:
    value = _format_value(action)
    return " ".join(filter(None, [action.option_strings[0], value])) if action.option_strings else value


def _format_value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    metavar = action.metavar or action.dest
    return metavar if isinstance(metavar, str) else " ".join(metavar)


def _format_action(action: argparse.Action) -> Iterator[str]:
    value, text = _format_value(action), action.help or ""
    found = _DEFAULT.search(text)
    default = found["value"] if found else None
    yield f"````{{option}} {', '.join(f'{each} {value}'.strip() for each in action.option_strings) or value}"
    yield " ".join(_DEFAULT.sub("", text).split())
    if default not in (None, "None", "", "False", "()"):
        yield f"Default: `{default}`."
    yield from ("````", "")


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directives."""
    app.add_directive("command-list", CommandList)
    app.add_directive("command-options", CommandOptions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
