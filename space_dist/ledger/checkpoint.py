"""Checkpoints as bytes: arrays and JSON in an uncompressed npz, with a hash over all of it."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.ledger.rows import ROW_FILES

FORMAT = 2  # 1: checkpoints without the episodes in progress. Such runs are read, and not gone on with
READABLE = (1, FORMAT)
_MAX_COUNT = 10**12  # rounds, transitions and bytes of a run's files stay below it, and names in twelve digits
_MAX_NAME = 1000  # characters of an array's
_ARRAY = "array/"


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Everything a run needs to go on: arrays by name, and plain JSON data."""

    round: int
    arrays: Mapping[str, NDArray[Any]]
    data: Mapping[str, Any]
    segments: tuple[Segment, ...] = ()
    format: int = FORMAT

    def under(self, prefix: str) -> dict[str, NDArray[Any]]:
        """The arrays whose names begin with `prefix`, without it."""
        return {name.removeprefix(prefix): array for name, array in self.arrays.items() if name.startswith(prefix)}


@dataclasses.dataclass(frozen=True)
class Segment:
    """A piece of a replay buffer: `count` transitions from the run's transition number `first` on, in a file."""

    first: int
    count: int
    sha256: str

    @property
    def name(self) -> str:
        """The file's; what it names never changes."""
        return f"{self.first:012d}-{self.first + self.count:012d}.npz"


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """An uncompressed npz; its `meta` names a SHA-256 over every array and all data."""
    segments = [[segment.first, segment.count, segment.sha256] for segment in checkpoint.segments]
    meta = {"round": checkpoint.round, "data": dict(checkpoint.data), "segments": segments}
    meta["format"] = checkpoint.format
    meta["sha256"] = _digest(meta, checkpoint.arrays)
    encoded = np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)
    return encode_arrays({"meta": encoded, **{f"{_ARRAY}{name}": array for name, array in checkpoint.arrays.items()}})


def decode_checkpoint(content: bytes) -> Checkpoint:
    """The inverse of `encode_checkpoint`. Raises ValueError for anything that is not exactly what was written."""
    arrays = decode_arrays(content)
    with _garbled():
        meta = json.loads(arrays.pop("meta").tobytes())
        if not all(name.startswith(_ARRAY) for name in arrays):
            raise ValueError("it holds what checkpoints do not")
        arrays = {name.removeprefix(_ARRAY): array for name, array in arrays.items()}
        written = meta.pop("sha256")
        if meta["format"] not in READABLE or written != _digest(meta, arrays):
            raise ValueError("checksum")
        segments = tuple(_checked_segment(*segment) for segment in meta["segments"])
        return Checkpoint(_count(meta["round"], "round"), arrays, dict(meta["data"]), segments, meta["format"])


def rows_under(checkpoint: Checkpoint) -> dict[str, tuple[int, str]]:
    """Row file -> its size and SHA-256 when the checkpoint was written. Raises ValueError for what no run has."""
    found = {}
    with _garbled():
        for name, (size, sha256) in checkpoint.data["files"].items():
            if name not in ROW_FILES:
                raise ValueError(f"it names a file {name[:80]!r} that runs do not have")
            found[name] = (_count(size, f"{name}'s size"), str(sha256))
    return found


def _checked_segment(first: object, count: object, sha256: object) -> Segment:
    begin, length = _count(first, "piece's first transition"), _count(count, "piece's length")
    if length < 1 or begin + length >= _MAX_COUNT:
        raise ValueError(f"it names a piece of {length} transitions from {begin} on")
    return Segment(begin, length, str(sha256))


def _count(value: object, what: str) -> int:
    """A whole number that runs can reach. Raises ValueError for any other."""
    if type(value) is not int or not 0 <= value < _MAX_COUNT:
        raise ValueError(f"its {what} is {str(value)[:80]!r}")
    return value


def _digest(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(json.dumps(meta, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        # Type and shape as well: the same bytes may be another array.
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def encode_arrays(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An uncompressed npz. NumPy's own streams into the archive, whose headers then differ by Python's version."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(array), allow_pickle=False)
            # A ZipInfo of its own has a fixed date (1980): equal arrays make equal bytes.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer())
    return buffer.getvalue()


def decode_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an npz of ours, by name. Raises ValueError if it is compressed, damaged, or named like a path."""
    with _garbled():
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise ValueError("compressed")
            # Before anything is unpacked: a small file may claim to hold terabytes.
            if sum(info.file_size for info in infos) > len(content):
                raise ValueError("sizes do not add up")
            names = [info.filename.removesuffix(".npy") for info in infos]
            for name in names:
                parts = name.removeprefix(_ARRAY).split("/")
                if len(name) > _MAX_NAME or not name.isprintable() or not parts[0] or ".." in parts:
                    raise ValueError(f"it names an array {name[:80]!r}")
            if len(set(names)) < len(names):
                raise ValueError("it names an array twice")
            if archive.testzip() is not None:  # before NumPy parses a header that may have changed
                raise ValueError("a checksum does not match")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return dict(file)


@contextlib.contextmanager
def _garbled() -> Iterator[None]:
    """Have anything that reading garbled bytes may raise be a ValueError."""
    try:
        yield
    except (zipfile.BadZipFile, KeyError, TypeError, AttributeError, OSError, EOFError, RecursionError,
            NotImplementedError, RuntimeError, MemoryError, SyntaxError, OverflowError, tokenize.TokenError,
            zlib.error) as error:  # fmt: skip
        raise ValueError(str(error)) from None
