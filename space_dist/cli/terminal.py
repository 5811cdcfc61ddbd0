"""What all commands share: the terminal, and requests to stop.

Imported before anything heavy: one thread for all arithmetic in every process of ours, before any library reads these.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - what follows must happen before anything heavy is imported
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from space_dist.interrupts import StopRequests

STOP = StopRequests()

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console

from space_dist.errors import ConfigError, nearest

console = Console()
errors = Console(stderr=True)

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders, or folders that hold some.")]
Overrides = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--set", metavar="KEY=VALUE", help="Override a config key, e.g. budget.steps=20000. Repeatable."),
]

Kwargs = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--kwarg", metavar="NAME=VALUE", help="An argument of the environment (env.kwargs). Repeatable."),
]

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def say(text: str) -> None:
    """Print a line as it is: no markup, no colours, no breaks."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def warn(text: str) -> None:
    """The same, on standard error."""
    errors.print(text, highlight=False, markup=False, soft_wrap=True)


def write(path: Path, text: str) -> None:
    """Write a file a user asked for. Raises ConfigError where that cannot be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None


def one_of(allowed: Sequence[str], text: str, option: str) -> str:
    """`text`, which an option was given. Raises ConfigError if it is not allowed."""
    if text not in allowed:
        raise ConfigError(f"{option} {text!r} is not known{nearest(text, allowed)} Allowed: {', '.join(allowed)}")
    return text


def parse_kwargs(given: list[str] | None) -> dict[str, Any]:
    """`NAME=VALUE` as YAML reads the value. Raises ConfigError for anything else."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    kwargs: dict[str, Any] = {}
    for one in given or []:
        name, equals, value = one.partition("=")
        if not equals or not name.isidentifier():
            raise ConfigError(f"--kwarg {one!r} is not NAME=VALUE")
        try:
            kwargs[name] = YAML(typ="safe", pure=True).load(value)
        except YAMLError:
            kwargs[name] = None
        if not isinstance(kwargs[name], bool | int | float | str):
            raise ConfigError(f"--kwarg {one!r}: the value must be a number, a word, true or false")
    return kwargs
