"""Weights & Biases, offline: a run there for each run and cell, in `wandb` in the folder of the grid, or of a lone run.

What is offline cannot be appended to. So a run is written whole whenever it has come to rest: done, failed, or
interrupted. `wandb sync` of the folder `offline-run-...` uploads it, under the same id each time.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from space_dist.tracking.sinks import Synced, note_synced, read_synced, turn
from space_dist.tracking.snapshot import NOTE_TAG, Record

FOLDER: Final = "wandb"
_PROJECT: Final = "space_dist"
_PATIENCE: Final = 60.0  # seconds for W&B's own process to write what it was given
_HEADER: Final = 7  # bytes, of a file and of each of its records
_BLOCK: Final = 32768  # bytes
_WHOLE_OR_LAST: Final = (1, 4)  # kinds of records: whole, first, middle, last part of one


class WeightsAndBiases:
    """A `Sink`."""

    def push(self, record: Record) -> None:
        """Write it whole, unless it is under way, or there. Raises OSError where the folder cannot be written."""
        if record.mlflow_status == "RUNNING":
            return
        with turn(record.root / FOLDER):
            self._push(record)

    def page(self, root: Path) -> str | None:
        """See `Sink`."""
        folder = root / FOLDER
        return f"{folder}: `wandb sync` uploads its folders offline-run-..." if folder.is_dir() else None

    def _push(self, record: Record) -> None:
        folder = record.root / FOLDER / record.name
        points = [*record.points(0)]
        now = Synced(points[-1][0] if points else 0, record.intent, record.mlflow_status)
        if read_synced(folder) == now:
            return
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Written beside and renamed: who syncs meanwhile finds whole runs only.
        with tempfile.TemporaryDirectory(prefix=".new", dir=folder.parent) as new:
            self._write(record, Path(new))
            for old in folder.glob("offline-run-*") if folder.is_dir() else ():
                shutil.rmtree(old)
            folder.mkdir(exist_ok=True)
            for made in Path(new, "wandb").glob("offline-run-*"):
                # W&B's process still writes of its own ending there (and NFS keeps the names of open files).
                shutil.rmtree(made / "logs", ignore_errors=True)
                made.rename(folder / made.name)
        note_synced(folder, now)

    def _write(self, record: Record, folder: Path) -> None:
        import wandb

        settings = wandb.Settings(
            # Nothing is sent anywhere, and nothing of this machine or its repository is recorded.
            mode="offline", console="off", silent=True, disable_git=True, disable_code=True, save_code=False,
            x_disable_stats=True, x_disable_meta=True, x_disable_machine_info=True, x_save_requirements=False,
        )  # fmt: skip
        config = {**record.params, "seed": record.tags.get("space_dist.seed", "")}
        try:
            run: Any = wandb.init(
                project=_PROJECT, id=record.key, name=record.title, group=record.group[:128], dir=folder,
                notes=record.tags.get(NOTE_TAG), config=config, settings=settings, reinit="create_new",
            )  # fmt: skip
        except wandb.Error as error:
            raise OSError(f"Weights & Biases writes no run: {error}") from error
        try:
            # W&B's own step counts calls of `log`; curves are over environment steps.
            run.define_metric("steps")
            run.define_metric("*", step_metric="steps")
            rows: dict[tuple[int, int], dict[str, float]] = {}
            for _, point in record.points(0):
                rows.setdefault((point.milliseconds, point.step), {})[point.name] = point.value
            for (milliseconds, step), numbers in rows.items():
                run.log({**numbers, "steps": step, "time/unix": milliseconds / 1000.0})
        finally:
            run.finish(exit_code=0 if record.mlflow_status == "FINISHED" else 1)
        await_exit(folder)


def await_exit(folder: Path) -> None:
    """Wait until the run in `folder` is on disk: `finish` only tells W&B's process to. Raises OSError if late."""
    deadline = time.monotonic() + _PATIENCE
    while not any(kind == "exit" for path in folder.glob("wandb/offline-run-*/*.wandb") for kind, _ in records(path)):
        if time.monotonic() > deadline:
            raise OSError(f"Weights & Biases has not written its run within {_PATIENCE:g} s")
        time.sleep(0.01)


def records(path: Path) -> Iterator[tuple[str, Any]]:
    """Kind and content of each record of an offline run's file, as far as it is written.

    They are parts in blocks of 32 KiB, as in LevelDB's log, that make messages of W&B's.
    """
    from wandb.proto import wandb_internal_pb2

    messages: Any = wandb_internal_pb2  # makes its classes as it is imported
    content, place, message = path.read_bytes(), _HEADER, b""
    while place + _HEADER <= len(content):
        if (room := -place % _BLOCK) < _HEADER and room:
            place += room
            continue
        _, length, part = struct.unpack_from("<IHB", content, place)
        if (place := place + _HEADER + length) > len(content):
            return
        message += content[place - length : place]
        if part in _WHOLE_OR_LAST:
            record = messages.Record()
            record.ParseFromString(message)
            message, kind = b"", record.WhichOneof("record_type")
            yield kind, getattr(record, kind)
