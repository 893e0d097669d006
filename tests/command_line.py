"""The command line as a user types it, without the seconds that a fresh interpreter takes to load it."""

import contextlib
import io
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from companion.cli import main


@dataclass(frozen=True, slots=True)
class Completed:
    """What a command left: exit code and texts."""

    returncode: int
    stdout: str
    stderr: str


def companion(*arguments: str | Path, cwd: Path) -> Completed:
    """Run ``companion ARGUMENTS`` in a folder, in this process."""
    out, err = io.StringIO(), io.StringIO()
    code: int | str | None = 0
    with (
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        patch.object(sys, "argv", ["companion", *map(str, arguments)]),
    ):
        try:
            main()
        except SystemExit as stop:
            code = stop.code
    assert isinstance(code, int), code
    return Completed(code, out.getvalue(), err.getvalue())
