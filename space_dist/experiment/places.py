"""Where a run may be put whose folder somebody names: in one that is its own, or that holds nothing of ours."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from space_dist.errors import ConfigError, LedgerError
from space_dist.experiment.manifest import MANIFEST, Grid
from space_dist.ledger import Ledger

_BELOW: Final = ("*/status.json", "*/*/status.json")  # `runs/NAME/s0` is where a run goes whose folder nobody names
_OWN: Final = "give the run a folder of its own"


def run_folder(folder: Path) -> Path:
    """The folder that a user names for one run, as it is.

    Raises ConfigError where it holds a grid or other runs, and where it lies within a run's, as whoever reads one of
    them would come upon the other; and where that cannot be told.
    """
    try:
        _refuse_others(folder)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be a run's folder: {error.strerror}") from None
    return folder


def _refuse_others(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder} is a file; {_OWN}")
    if Ledger(folder).exists():  # it may go on there, wherever that is
        return
    if what := _what_is_planned(folder):
        raise ConfigError(f"{folder} holds a {what}; {_OWN}")
    for above in folder.resolve().parents:
        if _is_run(above):
            raise ConfigError(f"{folder} lies inside of the run in {above}; {_OWN}")
    if (first := next(_runs_below(folder), None)) is not None:
        raise ConfigError(f"{folder} holds other runs, as {first}; {_OWN}, or name the one that is to go on")
    if grid := next((file.parent for file in folder.glob(f"*/{MANIFEST}") if _what_is_planned(file.parent)), None):
        raise ConfigError(f"{folder} holds the folders of grids, as {grid}; {_OWN}")


def _what_is_planned(folder: Path) -> str:
    """`grid` or `search`, where a folder is one's; else empty, as for somebody else's manifest.json."""
    with contextlib.suppress(LedgerError, OSError):
        return "grid" if Grid(folder).manifest().search is None else "search"
    return ""


def _runs_below(folder: Path) -> Iterator[Path]:
    return (file.parent for pattern in _BELOW for file in sorted(folder.glob(pattern)) if _is_run(file.parent))


def _is_run(folder: Path) -> bool:
    """Whether a folder has what a run writes first, and not somebody else's status.json alone."""
    ledger = Ledger(folder)
    return ledger.config.is_file() and ledger.status_file.is_file()
