"""What becomes of the numbers of a benchmark: kept in a file where one is named, and held against a limit."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console


def can_be_written(file: Path | None) -> Path | None:
    """A file's path as it is. Raises BadParameter, before anything is measured, where nothing can be written there."""
    try:
        if file is not None and file.is_dir():
            raise typer.BadParameter(f"{file} is a folder; name a file")
        if file is not None and not file.absolute().parent.is_dir():
            raise typer.BadParameter(f"there is no folder {file.absolute().parent}")
        writable = file is None or os.access(file if file.exists() else file.absolute().parent, os.W_OK)
    except OSError:  # below a folder that may not be looked into
        writable = False
    if not writable:
        raise typer.BadParameter(f"{file} cannot be written")
    return file


def can_be_a_folder(folder: Path | None) -> Path | None:
    """A folder's path as it is. Raises BadParameter, before anything is measured, where something else is there."""
    if folder is None:
        return None
    try:
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        if not there.is_dir():
            raise typer.BadParameter(f"{there} is no folder")
    except OSError:  # below a folder that may not be looked into
        raise typer.BadParameter(f"{folder} cannot be written to") from None
    if not os.access(there, os.W_OK):
        raise typer.BadParameter(f"{there} cannot be written to")
    return folder


JsonFile = Annotated[
    Optional[Path],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--json", help="Also write the numbers here.", callback=can_be_written),
]


def keep(numbers: Any, file: Path | None) -> None:
    """Write them as JSON, where a file is named."""
    if file is not None:
        file.write_text(json.dumps(numbers, indent=1) + "\n")


def refuse_if(exceeded: bool, console: Console) -> None:
    """End the benchmark with exit code 1 where a limit is exceeded."""
    if exceeded:
        console.print(
            '"At most" is exceeded. On a machine with other work that says little: measure again '
            "when it is quiet.", style="red",
        )  # fmt: skip
        raise typer.Exit(1)
