"""What `--help` tells reaches the reader: whole, and in lines as long as the terminal is wide."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from rich.text import Text
from typer.main import get_command
from typer.testing import CliRunner

from companion.cli import app

WIDTH = 80


def commands(command: Any, *words: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands(below, *words, name)


COMMANDS = dict(commands(get_command(app)))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_no_word_is_taken_for_markup(words: tuple[str, ...]) -> None:
    command = COMMANDS[words]
    for text in [command.help, *(getattr(param, "help", None) for param in command.params)]:
        bare = (text or "").replace("[bold]", "").replace("[/]", "")
        assert Text.from_markup(text or "").plain == bare


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_paragraphs_fill_the_lines_of_the_terminal(words: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": str(WIDTH)})
    assert shown.exit_code == 0, shown.output
    text, *boxes = shown.output.split("╭─")
    assert boxes
    lines = [line.strip() for line in text.splitlines()]
    for line, following in pairwise(lines):
        if line and following and not following.startswith("- "):
            assert len(line) + 1 + len(following.split()[0]) > WIDTH - 2, (line, following)
