"""TensorBoard: a file of events for each run and cell, in `tensorboard` in the folder of the grid, or of a lone run.

Its events are those of the ledger's rows, in their order, with their times and steps: the file is a function of them.
It is written behind what is known to be whole, so that whatever a death left half written goes.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Final

from space_dist.system.files import open_own
from space_dist.tracking.sinks import Synced, note_synced, read_synced, turn
from space_dist.tracking.snapshot import Point, Record

if TYPE_CHECKING:
    from tensorboard.compat.proto.event_pb2 import Event

FOLDER: Final = "tensorboard"
_EVENTS: Final = "events.out.tfevents.space_dist"  # by whose middle TensorBoard knows it


class TensorBoard:
    """A `Sink`."""

    def push(self, record: Record) -> None:
        """Add the rows that are not there. Raises OSError where the folder cannot be written."""
        with turn(record.root / FOLDER):
            self._push(record)

    def page(self, root: Path) -> str | None:
        """See `Sink`."""
        folder = root / FOLDER
        return f"{folder}: `{shlex.join(['tensorboard', '--logdir', str(folder)])}`" if folder.is_dir() else None

    def _push(self, record: Record) -> None:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter

        folder = record.root / FOLDER / record.name
        file, there = folder / _EVENTS, read_synced(folder)
        whole = file.is_file() and file.stat().st_size >= there.size
        if not whole or not record.continues(there.intent):
            file.unlink(missing_ok=True)
            there = Synced()
        folder.mkdir(parents=True, exist_ok=True)
        rows = there.rows
        with os.fdopen(open_own(file, os.O_RDWR | os.O_CREAT), "r+b") as stream:
            # Whatever a pusher that died has written behind what it noted.
            stream.truncate(there.size)
            stream.seek(there.size)
            writer = RecordWriter(stream)
            if not there.size:
                writer.write(Event(wall_time=record.started_at, file_version="brain.Event:2").SerializeToString())
            for complete, point in record.points(there.rows):
                rows = complete
                writer.write(_event(point).SerializeToString())
            stream.flush()
            # On disk before it is noted: a note of more than is there would leave a gap for good.
            os.fsync(stream.fileno())
            size = stream.tell()
        now = Synced(rows, record.intent, "", size)
        if now != there:
            note_synced(folder, now)


def _event(point: Point) -> Event:
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary

    value = Summary.Value(tag=point.name, simple_value=point.value)
    return Event(wall_time=point.milliseconds / 1000.0, step=point.step, summary=Summary(value=[value]))
