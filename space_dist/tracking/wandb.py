"""Weights & Biases, offline: a run there for each run and cell, in `wandb` in the folder of the grid, or of a lone run.

What is offline cannot be appended to. So a run is written whole whenever it has come to rest: done, failed, or
interrupted. `wandb sync` of the folder `offline-run-...` uploads it, under the same id each time.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any, Final

from space_dist.tracking.sinks import Synced, note_synced, read_synced, turn
from space_dist.tracking.snapshot import NOTE_TAG, Record

FOLDER: Final = "wandb"
_PROJECT: Final = "space_dist"


class WeightsAndBiases:
    """A `Sink`."""

    def push(self, record: Record) -> None:
        """Write it whole, unless it is under way, or there. Raises OSError where the folder cannot be written."""
        if record.mlflow_status == "RUNNING":
            return
        with turn(record.root / FOLDER):
            self._push(record)

    def _push(self, record: Record) -> None:
        folder = record.root / FOLDER / record.name
        points = [*record.points(0)]
        now = Synced(points[-1][0] if points else 0, record.intent, record.mlflow_status)
        if read_synced(folder) == now:
            return
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".new", dir=folder.parent) as new:
            self._write(record, Path(new))
            for old in folder.glob("offline-run-*") if folder.is_dir() else ():
                shutil.rmtree(old)
            folder.mkdir(exist_ok=True)
            for made in Path(new, "wandb").glob("offline-run-*"):
                made.rename(folder / made.name)
        note_synced(folder, now)

    def _write(self, record: Record, folder: Path) -> None:
        import wandb

        settings = wandb.Settings(
            mode="offline", console="off", silent=True, disable_git=True, disable_code=True, save_code=False,
            x_disable_stats=True, x_disable_meta=True, x_disable_machine_info=True,
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
            run.define_metric("steps")
            run.define_metric("*", step_metric="steps")
            rows: dict[tuple[int, int], dict[str, float]] = {}
            for _, point in record.points(0):
                rows.setdefault((point.milliseconds, point.step), {})[point.name] = point.value
            for (milliseconds, step), numbers in rows.items():
                run.log({**numbers, "steps": step, "time/unix": milliseconds / 1000.0})
        finally:
            run.finish(exit_code=0 if record.mlflow_status == "FINISHED" else 1)
