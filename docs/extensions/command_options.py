"""Directive `command-options`: every option of a command of mapctl, read from the command itself.

    ```{command-options} train lstm-gmm
    ```

The words name a command and, where it has some, its sub-command. Options become entries of Sphinx' `option`, so that
other pages can refer to them, and the search finds them.
"""

import argparse
import re
import warnings
from collections.abc import Iterator

import tyro
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mapctl.cli import STYLE
from mapctl.commands import COMMANDS, SUBCOMMANDS

_DEFAULT = re.compile(r"\s*\((default: (?P<value>.*)|required)\)\s*$", re.DOTALL)


class CommandOptions(SphinxDirective):
    """The options of a command, as Markdown that the page's own parser reads."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Parse the entries where the directive stands."""
        words = self.arguments[0].split()
        text = "\n".join(format_options(words))
        container = nodes.container()
        self.state.nested_parse(StringList(text.splitlines(), source=self.arguments[0]), self.content_offset, container)
        return container.children


def format_options(words: list[str]) -> Iterator[str]:
    """Lines of Markdown: what is typed first, then each option with its values, its meaning and its default."""
    parser = find_parser(words)
    name = " ".join(["mapctl", *words])
    actions = sorted(
        (each for each in parser._actions if each.dest != "help"), key=lambda each: bool(each.option_strings)
    )
    required = [_format_usage(each) for each in actions if each.required]
    yield from ("```text", " ".join([name, *required, "[options]"]), "```", "", f"```{{program}} {name}", "```", "")
    for action in actions:
        yield from _format_action(action)


def find_parser(words: list[str]) -> argparse.ArgumentParser:
    """The parser of a command; KeyError where there is none of these words."""
    kind = COMMANDS[words[0]] if len(words) == 1 else SUBCOMMANDS[words[0]][words[1]]
    with warnings.catch_warnings():
        # There is no other way yet to ask tyro for its options.
        warnings.simplefilter("ignore", DeprecationWarning)
        return tyro.extras.get_parser(kind, config=STYLE)


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
    """Add the directive."""
    app.add_directive("command-options", CommandOptions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
