"""Every command of both programs shows examples in its help, and each can be typed."""

import shlex

import pytest
from typer.main import get_command

import cvo_edge.programs.cli
import cvo_export.cli

PROGRAMS = {"cvo-edge": cvo_edge.programs.cli.app, "cvo-export": cvo_export.cli.app}


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_command_shows_examples_that_can_be_typed(program):
    for name, command in get_command(PROGRAMS[program]).commands.items():
        title, *lines = (command.epilog or "").split("\n\n")
        assert title == "Examples:", name
        assert lines, name
        for line in lines:
            words = shlex.split(line.split(" > ")[0].split(" | ")[-1])
            assert words[:2] == [program, name]
            command.make_context(name, words[2:])
