"""The command, in the test's own process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest

from space_dist import cli


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit code of `space-dist ARGUMENTS`; where modules are looked for stays as it was."""
    monkeypatch.setattr(sys, "argv", ["space-dist", *map(str, arguments)])
    monkeypatch.setattr(sys, "path", list(sys.path))
    try:
        cli.main()
    except SystemExit as error:
        return int(error.code or 0)
    return 0


Typed = Callable[..., subprocess.CompletedProcess[str]]


def typed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> subprocess.CompletedProcess[str]:
    """`space-dist ARGUMENTS` with all that it says."""
    capsys.readouterr()
    code = command(monkeypatch, *arguments)
    said = capsys.readouterr()
    return subprocess.CompletedProcess([*map(str, arguments)], code, said.out, said.err)
