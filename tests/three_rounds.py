"""A run of three rounds, written by hand, and what may befall who writes it."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from space_dist.ledger import (
    ROW_FILES,
    Checkpoint,
    Ledger,
    RunWriter,
    Status,
    encode_row,
)

ROWS_A_ROUND = 2


def status_of(round: int, **changes: Any) -> Status:
    fixed = Status(state="running", name="name", seed=3, steps=512 * round, budget_steps=4096, round=round,
                   started_at=1.5e9, updated_at=1.5e9 + round, fingerprint={"cpu": "none"})  # fmt: skip
    return dataclasses.replace(fixed, **changes)


def checkpoint_of(round: int, **changes: Any) -> Checkpoint:
    arrays = {
        "weights": np.full((2, 3), round, dtype=np.float32),
        "selected": np.arange(round, dtype=np.int64),
        "scalar": np.array(round, dtype=np.int64),
        "empty": np.empty((0, 4)),
    }
    return dataclasses.replace(Checkpoint(round, arrays, {"run": {"round": round, "sums": [0.5, None]}}), **changes)


def row_of(name: str, round: int, index: int) -> dict[str, Any]:
    return {"file": name, "round": round, "index": index, "value": round / 7}


def rows_until(name: str, round: int) -> list[dict[str, Any]]:
    return [row_of(name, one, index) for one in range(1, round + 1) for index in range(ROWS_A_ROUND)]


def append_round(writer: RunWriter, round: int) -> None:
    for name in ROW_FILES:
        for index in range(ROWS_A_ROUND):
            writer.append(name, row_of(name, round, index))


def write_rounds(writer: RunWriter, first: int, last: int) -> None:
    for number in range(first, last + 1):
        append_round(writer, number)
        writer.commit(checkpoint_of(number), status_of(number))


def same(one: Checkpoint, other: Checkpoint, *, without: tuple[str, ...] = ("files", "about")) -> bool:
    def plain(checkpoint: Checkpoint) -> Any:
        data = {key: value for key, value in checkpoint.data.items() if key not in without}
        arrays = {name: (array.dtype, array.shape, array.tobytes()) for name, array in checkpoint.arrays.items()}
        return checkpoint.round, json.dumps(data, sort_keys=True), arrays, checkpoint.segments

    return bool(plain(one) == plain(other))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    """Of a run of three rounds, whose writer is gone."""
    ledger = Ledger(tmp_path / "run")
    with RunWriter(ledger) as writer:
        assert writer.restore() is None
        write_rounds(writer, 1, 3)
    return ledger


def restored(ledger: Ledger) -> int:
    """The round that a fresh writer finds, with all rows and the checkpoint as they were written."""
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
    found = 0 if checkpoint is None else checkpoint.round
    if checkpoint is not None:
        assert same(checkpoint, checkpoint_of(found))
    for name in ROW_FILES:
        assert (ledger.folder / name).read_bytes() == b"".join(map(encode_row, rows_until(name, found)))
    return found


def in_a_fork(action: Callable[[], object]) -> int:
    """Run `action` in a process of its own; 0 if it came to its end, 1 if it raised, else what it died of."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            action()
            code = 0
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def failing(number: int) -> Callable[..., NoReturn]:
    def fail(*_: object, **__: object) -> NoReturn:
        raise OSError(number, os.strerror(number), "somewhere")

    return fail


WRITES: dict[str, Callable[[RunWriter], object]] = {
    "commit": lambda writer: writer.commit(checkpoint_of(4), status_of(4)),
    "set_status": lambda writer: writer.set_status(status_of(3)),
    "write_config": lambda writer: writer.write_config("a", "b", "c"),
    "write_model": lambda writer: writer.write_model({"w": np.zeros(1)}, {}),
    "write_segment": lambda writer: writer.write_segment(0, 1, {"w": np.zeros(1)}),
    "restore": lambda writer: writer.restore(),
}
