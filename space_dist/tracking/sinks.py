"""Where else than in MLflow runs and grids are shown: what all such places have in common, and which there are.

A sink is fed by the process that pushes, from what ledgers hold: nothing of training knows of it or waits for it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from space_dist.config.sections import Sink as SinkName
from space_dist.errors import ConfigError
from space_dist.system.files import atomic_write, locked, read_file
from space_dist.tracking.snapshot import Record

_PACKAGES: Final[Mapping[SinkName, str]] = {"tensorboard": "tensorboard", "wandb": "wandb"}
_LOCK: Final = "tracking.lock"
_TURN_SECONDS: Final = 600.0
_STATE: Final = "synced.json"
_MAX_STATE: Final = 10_000  # bytes


class Sink(Protocol):
    """Shows runs, and cells of grids, elsewhere. Pushing twice changes nothing."""

    def push(self, record: Record) -> None:
        """Bring it up to date. Raises OSError where it cannot be written."""

    def page(self, root: Path) -> str | None:
        """Where people look at what is there of a run's or a grid's folder, in words; None if nothing is."""


@dataclass(frozen=True)
class Synced:
    """What is there of a record already: so many rows, which were these; and how many bytes they take."""

    rows: int = 0
    intent: str = ""
    ending: str = ""
    size: int = 0


def refuse_missing(names: Sequence[SinkName]) -> None:
    """Raise ConfigError for a sink whose package is not installed."""
    for name in names:
        if importlib.util.find_spec(_PACKAGES[name]) is None:
            raise ConfigError(
                f"tracking.sinks: {name} needs the package {_PACKAGES[name]}, which is not installed here: "
                f"pip install 'space-dist[{name}]', or leave it out"
            )


def sink_of(name: SinkName) -> Sink:
    """A sink by what a config calls it. Raises ConfigError where its package is not installed."""
    refuse_missing([name])
    if name == "tensorboard":
        from space_dist.tracking.tensorboard import TensorBoard

        return TensorBoard()
    from space_dist.tracking.wandb import WeightsAndBiases

    return WeightsAndBiases()


@contextlib.contextmanager
def turn(folder: Path) -> Iterator[None]:
    """Be the only one who writes into a sink's folder, which is made. Waits for others; whoever dies lets go at once.

    Raises OSError where it cannot be written, or nobody lets go.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / _LOCK, _TURN_SECONDS):
        yield


def read_synced(folder: Path) -> Synced:
    """What a sink noted in its folder; nothing if that is not what it wrote."""
    try:
        data: Any = json.loads(read_file(folder / _STATE, _MAX_STATE))
        found = Synced(**data)
    # Nothing is known then, and everything is written again: pushing twice changes nothing.
    except (OSError, ValueError, TypeError, RecursionError):
        return Synced()
    numbers = all(type(value) is int and value >= 0 for value in (found.rows, found.size))
    return found if numbers and isinstance(found.intent, str) and isinstance(found.ending, str) else Synced()


def note_synced(folder: Path, synced: Synced) -> None:
    """Write it down, after what it says is there."""
    atomic_write(folder / _STATE, json.dumps(dataclasses.asdict(synced)).encode())
