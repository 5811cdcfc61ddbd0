"""Rows: lines of JSON that say themselves whether they are whole, in files that only grow."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.errors import LedgerError

Row = dict[str, Any]
METRICS, TIMING, CURRICULUM, VALUES = "metrics.jsonl", "timing.jsonl", "curriculum.jsonl", "values.jsonl"
ROW_FILES = (METRICS, TIMING, CURRICULUM, VALUES)
MOST_VALUED = 10_000  # instances whose start values are kept for every decision: some 50 kB a row
_CRC_LENGTH = len(',"crc":"00000000"}\n')


def encode_row(row: Row) -> bytes:
    """One line: the row as JSON with its own CRC-32 as last field."""
    # NaN is no JSON: other readers than Python's refuse a file that has it.
    body = json.dumps(row, separators=(",", ":"), allow_nan=False)
    return f'{body[:-1]},"crc":"{zlib.crc32(body.encode()):08x}"}}\n'.encode()


def decode_row(line: bytes) -> Row | None:
    """The row without its CRC; None where the line is torn or was changed."""
    body = line[:-_CRC_LENGTH] + b"}"
    if line[-_CRC_LENGTH:] != f',"crc":"{zlib.crc32(body):08x}"}}\n'.encode():
        return None
    try:
        row = json.loads(body)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) else None


def encode_values(values: NDArray[np.float64]) -> Row:
    """(n,) start values, bit for bit: {"f4" or "f8": base64 of little-endian floats}; f4 where nothing is lost."""
    with np.errstate(over="ignore"):
        kind = "f4" if np.array_equal(values.astype(np.float32).astype(np.float64), values) else "f8"
    return {kind: base64.b64encode(values.astype(f"<{kind}").tobytes()).decode()}


def decode_values(encoded: object) -> NDArray[np.float64]:
    """The inverse of `encode_values`. Raises LedgerError for anything else."""
    try:
        ((kind, text),) = dict(encoded).items()  # type: ignore[call-overload]
        if kind not in ("f4", "f8"):
            raise ValueError(kind)
        return np.frombuffer(base64.b64decode(text, validate=True), dtype=f"<{kind}").astype(np.float64)
    except (ValueError, TypeError):
        raise LedgerError("start values are a JSON object of one key, f4 or f8, with floats in base64") from None
