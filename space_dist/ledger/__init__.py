"""A run's own folder: the truth about it.

    config.yaml           what was asked for, resolved; with instances_train.csv and instances_test.csv beside it, and
                          with what other runs gave it: init.npz, the networks it started from (`init_from`), and
                          recorded.npz, the curriculum it follows (`curriculum.of`)
    status.json           where the run stands (atomic); names the last checkpoint, how much of each file it covers, and
                          the hashes of the files that are written whole
    metrics.jsonl         one row per iteration and per evaluation; a pure function of config and seed
    curriculum.jsonl      one row per iteration: which instances were trained on
    values.jsonl          one row per decision: the start values of all instances behind it (`encode_values`);
                          row 0 is V_0, with the bounds of contexts. Not of sets above MOST_VALUED instances
    timing.jsonl          one row per row of metrics.jsonl: when, and how long it took
    checkpoints/*.npz     the last two; arrays and JSON, never a pickle
    replay/*.npz          what replay buffers hold, in pieces that are written once and named by the checkpoints
    model.npz, model.json the trained policy, once the run is done
    log.txt               what the run said

Rows carry a CRC. Rows behind the last checkpoint are *uncommitted*: a resumed run cuts them off and writes the same
bytes again. Commits are ordered so that a kill between any two system calls leaves a folder that resumes: rows are
flushed to disk, then the checkpoint is renamed into place, then the status. A checkpoint holds a hash of itself, of the
rows and pieces it covers, and of the configuration it belongs to; what is damaged is noticed before it is used.

Modules, each of which imports from those below it:

    writer                the owner's side: rows, checkpoints, status
    folder                the reader's side, and every path
    lock                  who the owner is
    checkpoint, rows      what is in the files, as bytes
"""

from __future__ import annotations

from space_dist.ledger.checkpoint import (
    FORMAT,
    Checkpoint,
    Segment,
    decode_arrays,
    decode_checkpoint,
    encode_arrays,
    encode_checkpoint,
)
from space_dist.ledger.folder import GIVEN, GOES_BACK, Ledger, State, Status, absent, find_ledgers, there
from space_dist.ledger.lock import LEASE_SECONDS, Lock, believed_alive, owner_alive, process_of, this_process
from space_dist.ledger.rows import (
    CURRICULUM,
    METRICS,
    MOST_VALUED,
    ROW_FILES,
    TIMING,
    VALUES,
    Row,
    decode_row,
    decode_values,
    encode_row,
    encode_values,
)
from space_dist.ledger.writer import RunWriter

__all__ = [
    "CURRICULUM",
    "FORMAT",
    "GIVEN",
    "GOES_BACK",
    "LEASE_SECONDS",
    "METRICS",
    "MOST_VALUED",
    "ROW_FILES",
    "TIMING",
    "VALUES",
    "Checkpoint",
    "Ledger",
    "Lock",
    "Row",
    "RunWriter",
    "Segment",
    "State",
    "Status",
    "absent",
    "believed_alive",
    "decode_arrays",
    "decode_checkpoint",
    "decode_row",
    "decode_values",
    "encode_arrays",
    "encode_checkpoint",
    "encode_row",
    "encode_values",
    "find_ledgers",
    "owner_alive",
    "process_of",
    "there",
    "this_process",
]
