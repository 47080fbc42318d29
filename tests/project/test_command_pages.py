"""A page a command: each shows all options of its command, and of its sub-commands."""

import pages
import pytest

from mapctl.commands import COMMANDS, SUBCOMMANDS

command_options = pages.import_extension("command_options")

ALL = [[name] for name in COMMANDS if name not in SUBCOMMANDS]
ALL += [[name, sub] for name, kinds in SUBCOMMANDS.items() for sub in kinds]


@pytest.mark.parametrize("words", ALL, ids=" ".join)
def test_every_command_has_its_options_on_its_page(words):
    page = pages.read_page(f"docs/commands/{words[0]}.md")
    assert f"```{{command-options}} {' '.join(words)}\n" in page
    assert page.startswith(f"# mapctl {words[0]}\n")


@pytest.mark.parametrize("words", ALL, ids=" ".join)
def test_options_are_those_of_the_command(words):
    text = "\n".join(command_options.format_options(words))
    parser = command_options.find_parser(words)
    for action in parser._actions:
        if action.dest != "help":
            assert all(option in text for option in action.option_strings)
    assert "==SUPPRESS==" not in text


def test_the_list_of_commands_links_to_every_page():
    index = pages.read_page("docs/commands/index.md")
    assert "```{command-list}" in index
    assert [line for line in index.splitlines() if line in COMMANDS] == list(COMMANDS)
