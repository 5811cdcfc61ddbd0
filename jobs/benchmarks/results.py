"""What becomes of the numbers of a benchmark: kept in a file where one is named, and held against a limit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console

JsonFile = Annotated[
    Optional[Path],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--json", help="Also write the numbers here."),
]


def keep(numbers: Any, file: Path | None) -> None:
    """Write them as JSON, where a file is named."""
    if file is not None:
        file.write_text(json.dumps(numbers, indent=1) + "\n")


def refuse_if(exceeded: bool, console: Console) -> None:
    """End the benchmark with exit code 1 where a limit is exceeded."""
    if exceeded:
        console.print("A limit is exceeded.", style="red")
        raise typer.Exit(1)
