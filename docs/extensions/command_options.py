"""Directives that read the command line: `command-list`, a table of all commands, and `command-options WORDS`, the
description and options of a command (`follow`) or sub-command (`train lstm-gmm`)."""

import re
import warnings
from collections.abc import Iterable, Iterator

import tyro
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mapctl.cli import STYLE
from mapctl.commands import COMMANDS, load_command
from mapctl.commands.train import load_recipe

_DEFAULT = re.compile(r"\s*\((default: (?P<value>.*)|required)\)\s*$", re.DOTALL)


class MarkdownDirective(SphinxDirective):
    """A directive whose lines the page's own parser reads."""

    def parse(self, lines: Iterable[str]) -> list[nodes.Node]:
        """Parse lines as if they stood in the page."""
        container = nodes.container()
        text = StringList("\n".join(lines).splitlines(), source=self.name)
        self.state.nested_parse(text, self.content_offset, container)
        return container.children


class CommandList(MarkdownDirective):
    """A table of all commands, each a link to the page of its name."""

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        rows = (f"| [{name}]({name}.md) | {summary.rstrip('.')} |" for name, (_, summary) in COMMANDS.items())
        return self.parse(["| command | what it does |", "|---|---|", *rows])


class CommandOptions(MarkdownDirective):
    """The options of a command."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Parse the entries."""
        return self.parse(_format_options(self.arguments[0].split()))


def _describe(kind: type) -> str:
    return " ".join((kind.__doc__ or "").split())


def _format_options(words: list[str]) -> Iterator[str]:
    kind = load_command(words[0]) if len(words) == 1 else load_recipe(words[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # tyro has no other interface to its options
        parser = tyro.extras.get_parser(kind, config=STYLE)
    actions = [each for each in parser._actions if each.dest != "help"]
    actions.sort(key=lambda each: bool(each.option_strings))
    name = " ".join(["mapctl", *words])
    required = [" ".join(filter(None, [*each.option_strings[:1], _value(each)])) for each in actions if each.required]
    if len(words) > 1:
        yield from (_describe(kind), "")
    yield from ("```text", " ".join([name, *required, "[options]"]), "```", "", f"```{{program}} {name}", "```", "")
    for action in actions:
        found = _DEFAULT.search(action.help or "")
        names = ", ".join(f"{each} {_value(action)}".strip() for each in action.option_strings)
        yield f"````{{option}} {names or _value(action)}"
        yield " ".join(_DEFAULT.sub("", action.help or "").split())
        if found and found["value"] not in (None, "None", "", "False", "()"):
            yield f"Default: `{found['value']}`."
        yield from ("````", "")


def _value(action) -> str:
    if action.nargs == 0:
        return ""
    metavar = action.metavar or action.dest
    return metavar if isinstance(metavar, str) else " ".join(metavar)


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directives."""
    app.add_directive("command-list", CommandList)
    app.add_directive("command-options", CommandOptions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
