"""A run's own folder: the truth about it.

    config.yaml           what was asked for, resolved; with instances_train.csv and instances_test.csv beside it
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
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import errno
import functools
import hashlib
import io
import json
import logging
import os
import re
import socket
import threading
import time
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from space_dist.errors import LedgerError, RunLockedError
from space_dist.system.files import TEMPORARIES, appending, atomic_write, locked, read_file, why_not_own

log = logging.getLogger("space_dist")

Row = dict[str, Any]
State = Literal["running", "interrupted", "failed", "done"]

METRICS, TIMING, CURRICULUM, VALUES = "metrics.jsonl", "timing.jsonl", "curriculum.jsonl", "values.jsonl"
ROW_FILES = (METRICS, TIMING, CURRICULUM, VALUES)
MOST_VALUED = 10_000  # instances whose start values are kept for every decision: some 50 kB a row
FORMAT = 2  # 1: checkpoints without the episodes in progress. Such runs are read, and not gone on with
READABLE = (1, FORMAT)
KEPT_CHECKPOINTS = 2
LEASE_SECONDS = 120.0  # how long an owner that cannot be seen from here is believed to live after its last sign
HEARTBEAT_SECONDS = 10.0
CLAIM_SECONDS = 10.0  # for a lock that another process holds; it does so while it writes
OWNER_SECONDS = 60.0  # the same for the owner, whose run ends then
_MAX_STATUS_BYTES = 1 << 20
_MAX_COUNT = 10**12  # rounds, transitions and bytes of a run's files stay below it, and names in twelve digits
_MAX_NAME = 1000  # characters of an array's
_ARRAY = "array/"
_CHECKPOINT = re.compile(r"round-[0-9]{9,12}\.npz")
_READINGS = 3  # of a file and the status that names it, which a live writer may be replacing
_CRC_LENGTH = len(',"crc":"00000000"}\n')


@dataclasses.dataclass(frozen=True)
class Status:
    """`status.json`. Steps are real environment steps of training; times are seconds since the epoch."""

    state: State
    name: str
    seed: int
    steps: int
    budget_steps: int
    round: int
    started_at: float
    updated_at: float
    message: str | None = None
    committed: Mapping[str, int] = dataclasses.field(default_factory=dict)  # file name -> bytes under a checkpoint
    checkpoint: str | None = None
    checkpoint_sha256: str | None = None
    # Name -> SHA-256 of the files that are written whole: two of a file that is just being replaced
    files: Mapping[str, list[str]] = dataclasses.field(default_factory=dict)
    identity: str | None = None  # a hash of everything that decides the run's results
    fingerprint: Mapping[str, str] = dataclasses.field(default_factory=dict)
    fingerprint_changed: bool = False  # resumed where bit-equality is not promised
    format: int = FORMAT


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


def encode_row(row: Row) -> bytes:
    """One line: the row as JSON with its own CRC-32 as last field."""
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


class Ledger:
    """The one class that knows the paths of a run. Reading needs no lock; writing is `RunWriter`'s."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).absolute()
        self.config = self.folder / "config.yaml"
        self.status_file = self.folder / "status.json"
        self.checkpoints = self.folder / "checkpoints"
        self.replay = self.folder / "replay"
        self.log = self.folder / "log.txt"
        self.stop_file = self.folder / "stop"
        self.lock_file = self.folder / "lock.json"
        self.model_arrays = self.folder / "model.npz"
        self.model_description = self.folder / "model.json"

    def __repr__(self) -> str:
        return f"Ledger({str(self.folder)!r})"

    def exists(self) -> bool:
        """Whether a run was ever started here."""
        return self.config.exists() or self.status_file.exists()

    def instances(self, split: Literal["train", "test"]) -> Path:
        """The run's own copy of an instance set."""
        return self.folder / f"instances_{split}.csv"

    def status(self) -> Status:
        """Read `status.json`. Raises LedgerError if it is missing or damaged."""
        try:
            content = read_file(self.status_file, _MAX_STATUS_BYTES + 1)
        except FileNotFoundError:
            raise LedgerError(f"{self.folder} holds no run: it has no status.json") from None
        except OSError as error:
            raise LedgerError(f"{self.status_file} cannot be read: {error.strerror}") from None
        try:
            data = json.loads(content)
            crc = data.pop("crc")
            if crc != zlib.crc32(json.dumps(data, sort_keys=True).encode()):
                raise ValueError("checksum")
            if data["format"] not in READABLE:
                raise LedgerError(
                    f"{self.status_file} has format {data['format']}; this version reads formats "
                    f"{' and '.join(map(str, READABLE))}"
                )
            status = Status(**data)
            if status.checkpoint is not None and not _CHECKPOINT.fullmatch(status.checkpoint):
                raise ValueError("it names what is no checkpoint")
            if any(Path(name).name != name for name in status.files):
                raise ValueError("it names files elsewhere")
            return status
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            raise LedgerError(f"{self.status_file} is damaged") from None

    def rows(self, name: str = METRICS, *, committed_only: bool = False) -> list[Row]:
        """The intact rows of a file from its start; a torn last row (a run being written or killed) is left out.

        Raises LedgerError if a row before the last one is damaged, naming file and row, and if rows that a checkpoint
        covers are gone.
        """
        path = self.folder / name
        for _ in range(_READINGS):  # a run that is resumed from an earlier checkpoint says so before it cuts its rows
            committed = self.status().committed.get(name, 0) if committed_only or self.status_file.exists() else 0
            content = _read(path, missing=b"")
            if len(content) >= committed:
                break
        else:
            raise LedgerError(
                f"{path} is damaged: it holds {len(content)} bytes of the {committed} that were committed"
            )
        if committed_only:
            content = content[:committed]
        lines = content.splitlines(keepends=True)
        rows, intact = [], 0
        for number, line in enumerate(lines, start=1):
            row = decode_row(line)
            if row is None:
                if number == len(lines) and not line.endswith(b"\n") and intact >= committed:
                    break
                raise LedgerError(f"{path}, row {number}: damaged (its checksum does not match)")
            rows.append(row)
            intact += len(line)
        return rows

    def read(self, path: Path) -> bytes:
        """A file of the run that is written whole (config, instances, model), as its writer left it.

        Raises LedgerError if it is missing, cannot be read, or is not what `status.json` says it is.
        """
        for _ in range(_READINGS):
            content = _read(path)
            known = self.status().files.get(path.name)
            if known is None or hashlib.sha256(content).hexdigest() in known:
                return content
        raise LedgerError(f"{path} is damaged: its checksum is not the one that status.json names")

    def damage(self) -> list[str]:
        """What of a run's results and of what it was asked is no longer as `status.json` says, one sentence each."""
        checks: list[Callable[[], object]] = [
            functools.partial(self.read, self.folder / name) for name in self.status().files
        ]
        checks += [functools.partial(self.rows, name, committed_only=True) for name in ROW_FILES]
        found = []
        for check in checks:
            try:
                check()
            except LedgerError as error:
                found.append(str(error))
        return found

    def checkpoint_files(self) -> list[Path]:
        """Newest first."""
        return sorted(self.checkpoints.glob("round-*.npz"), reverse=True)

    def last_checkpoint(self) -> Checkpoint | None:
        """The one that `status.json` names; None before the first. Raises LedgerError if it is damaged or gone."""
        name = self.status().checkpoint
        for _ in range(_READINGS):  # a live writer removes the one before the last
            if name is None:
                return None
            with contextlib.suppress(LedgerError, ValueError):
                return decode_checkpoint(_read(self.checkpoints / name))
            name = self.status().checkpoint
        raise LedgerError(
            f"the last checkpoint in {self.checkpoints}, {name}, is damaged or missing; --resume goes on from the one "
            "before it"
        )

    def abandoned(self, status: Status) -> bool:
        """Whether the run was left behind by a process that is gone, and could not say why."""
        return status.state == "running" and not self.owner_alive()

    def owner_alive(self) -> bool:
        """Whether a live process works on this run now, as far as can be told from this machine."""
        return owner_alive(self.lock_file)


def owner_alive(lock_file: Path) -> bool:
    """Whether a live process holds the lock, as far as can be told from this machine.

    Another user's lock cannot be read: that its owner lives is believed for a lease after its last sign.
    """
    try:
        return believed_alive(_owner(lock_file))
    except PermissionError:
        with contextlib.suppress(OSError):
            return abs(time.time() - lock_file.stat().st_mtime) < LEASE_SECONDS
    except OSError:
        pass
    return False


def _owner(lock_file: Path) -> dict[str, Any]:
    """What a lock says of its owner; nothing if it is garbled. Raises OSError if it cannot be read."""
    return _decoded_owner(read_file(lock_file, _MAX_STATUS_BYTES))


def _decoded_owner(content: bytes) -> dict[str, Any]:
    try:
        owner = json.loads(content or b"{}")
    except (ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _read(path: Path, *, missing: bytes | None = None) -> bytes:
    """A file's content; `missing`, if given, where there is none. Raises LedgerError if that cannot be had."""
    try:
        return read_file(path)
    except FileNotFoundError:
        if missing is not None:
            return missing
        raise LedgerError(f"{path.parent} is incomplete: it has no {path.name}") from None
    except OSError as error:
        raise LedgerError(f"{path} cannot be read: {error.strerror}") from None


def find_ledgers(paths: list[Path]) -> list[Ledger]:
    """Every run in or below `paths`, sorted by path, each once. Raises LedgerError where there is none."""
    found: dict[Path, Ledger] = {}
    for path in paths:
        if not path.exists():
            raise LedgerError(f"{path} does not exist")
        below = [Ledger(path)] if (path / "status.json").exists() else []
        below += [Ledger(file.parent) for file in path.rglob("status.json") if path.is_dir()]
        if not below:
            raise LedgerError(f"no run found in {path}: no folder there has a status.json")
        found |= {ledger.folder.resolve(): ledger for ledger in below}
    return [found[key] for key in sorted(found)]


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """An uncompressed npz; its `meta` names a SHA-256 over every array and all data."""
    segments = [[segment.first, segment.count, segment.sha256] for segment in checkpoint.segments]
    meta = {"round": checkpoint.round, "data": dict(checkpoint.data), "segments": segments}
    meta["format"] = checkpoint.format
    meta["sha256"] = _digest(meta, checkpoint.arrays)
    buffer = io.BytesIO()
    encoded = np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)
    _savez(buffer, {"meta": encoded, **{f"{_ARRAY}{name}": array for name, array in checkpoint.arrays.items()}})
    return buffer.getvalue()


def decode_checkpoint(content: bytes) -> Checkpoint:
    """The inverse of `encode_checkpoint`. Raises ValueError for anything that is not exactly what was written."""
    arrays = _decode_arrays(content)
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


def _decode_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an npz of ours, by name. Raises ValueError if it is compressed, damaged, or named like a path."""
    with _garbled():
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise ValueError("compressed")
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


def _count(value: object, what: str) -> int:
    """A whole number that runs can reach. Raises ValueError for any other."""
    if type(value) is not int or not 0 <= value < _MAX_COUNT:
        raise ValueError(f"its {what} is {str(value)[:80]!r}")
    return value


def _checked_segment(first: object, count: object, sha256: object) -> Segment:
    begin, length = _count(first, "piece's first transition"), _count(count, "piece's length")
    if length < 1 or begin + length >= _MAX_COUNT:
        raise ValueError(f"it names a piece of {length} transitions from {begin} on")
    return Segment(begin, length, str(sha256))


def _rows_under(checkpoint: Checkpoint) -> dict[str, tuple[int, str]]:
    """Row file -> its size and SHA-256 when the checkpoint was written. Raises ValueError for what no run has."""
    found = {}
    with _garbled():
        for name, (size, sha256) in checkpoint.data["files"].items():
            if name not in ROW_FILES:
                raise ValueError(f"it names a file {name[:80]!r} that runs do not have")
            found[name] = (_count(size, f"{name}'s size"), str(sha256))
    return found


def _savez(buffer: io.BytesIO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """An uncompressed npz. NumPy's own streams into the archive, whose headers then differ by Python's version."""
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer())


def _digest(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(json.dumps(meta, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class RunWriter:
    """The owner's side of a ledger: holds the lock, appends rows, commits checkpoints.

    Use as a context manager. `restore` must be called once before the first `append`.
    """

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._lock = Lock(ledger.lock_file)
        self._hashes = {name: hashlib.sha256() for name in ROW_FILES}
        self._sizes = dict.fromkeys(ROW_FILES, 0)
        self._files: dict[str, list[str]] = {}  # SHA-256 of the whole files that this process wrote
        self._named: dict[str, set[str]] = {}  # the pieces of replay buffers that each checkpoint names
        self.status: Status | None = None

    def __enter__(self) -> RunWriter:
        with _clear_errors(self.ledger.folder):
            self.ledger.folder.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            try:
                self.ledger.checkpoints.mkdir(exist_ok=True)
                for folder in (self.ledger.folder, self.ledger.checkpoints, self.ledger.replay):
                    for left_behind in folder.glob(TEMPORARIES):  # by a process that was killed while it wrote
                        left_behind.unlink()
            except BaseException:
                self._lock.release()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def write_config(self, config: str, train: str, test: str) -> None:
        """Record what was asked for. The config comes last: a folder that has one is complete.

        Where there is a status, it names both the old and the new content until the next one is written.
        """
        asked = {
            self.ledger.instances("train"): train.encode(),
            self.ledger.instances("test"): test.encode(),
            self.ledger.config: config.encode(),
        }
        with _clear_errors(self.ledger.folder), self._lock.held():
            hashes = {path.name: hashlib.sha256(content).hexdigest() for path, content in asked.items()}
            if self.status is not None:
                before = self.status.files
                both = {name: sorted({*before.get(name, []), sha256}) for name, sha256 in hashes.items()}
                self._write_status(dataclasses.replace(self.status, files={**before, **both}))
            for path, content in asked.items():
                atomic_write(path, content)
            self._files |= {name: [sha256] for name, sha256 in hashes.items()}

    def restore(self) -> Checkpoint | None:
        """Cut every row file back to the newest intact checkpoint and return it; to nothing where none was written.

        Raises LedgerError, and changes nothing, if something cannot be read that may be intact, if there are
        checkpoints but none fits what is there, and if the status names one but there is none.
        """
        files = self.ledger.checkpoint_files()
        named = None if self.status is None else self.status.checkpoint
        reasons = [f"{named}: missing"] if named is not None and (not files or files[0].name < named) else []
        for file in files:
            try:
                content = self._intact_or_refused(file)
                checkpoint = decode_checkpoint(content)
                prefixes = self._verified_prefixes(checkpoint)
            except ValueError as error:
                reasons.append(f"{file.name}: {error}")
                continue
            if reasons:
                log.warning("going back to the checkpoint of round %d (%s)", checkpoint.round, "; ".join(reasons))
            with _clear_errors(self.ledger.folder), self._lock.held():
                self._point_at(file.name, content, checkpoint)
                self._cut(prefixes)
                for newer in files[: files.index(file)]:
                    newer.unlink()
            return checkpoint
        if reasons:
            raise LedgerError(
                f"{self.ledger.folder} cannot be resumed: no checkpoint is intact ({'; '.join(reasons)}). "
                "Nothing was changed; start the run in another folder"
            )
        with _clear_errors(self.ledger.folder), self._lock.held():
            self._cut(dict.fromkeys(ROW_FILES, b""))
        return None

    def _intact_or_refused(self, path: Path) -> bytes:
        """A file's content. Raises ValueError if it is gone, LedgerError if it may be intact but cannot be read now."""
        try:
            return read_file(path)
        except FileNotFoundError:
            raise ValueError(f"{path.name} is missing") from None
        except OSError as error:
            raise LedgerError(
                f"{self.ledger.folder} cannot be resumed now: {path} cannot be read ({error.strerror}). "
                "Nothing was changed; once the cause is gone, --resume continues"
            ) from error

    def _point_at(self, name: str, content: bytes, checkpoint: Checkpoint) -> None:
        """Let the status name the checkpoint that is used, before another one that it may name is removed."""
        sizes = {file: size for file, (size, _) in _rows_under(checkpoint).items()}
        if self.status is None or (self.status.checkpoint, self.status.committed) == (name, sizes):
            return
        self._write_status(
            dataclasses.replace(
                self.status, round=checkpoint.round, steps=checkpoint.data.get("about", {}).get("steps", 0),
                committed=sizes, checkpoint=name, checkpoint_sha256=hashlib.sha256(content).hexdigest(),
            )
        )  # fmt: skip

    def _verified_prefixes(self, checkpoint: Checkpoint) -> dict[str, bytes]:
        theirs = checkpoint.data.get("about", {}).get("identity")
        ours = None if self.status is None else self.status.identity
        if theirs != ours and None not in (theirs, ours):
            raise ValueError("it belongs to a run of another configuration")
        for segment in checkpoint.segments:
            content = self._intact_or_refused(self._segment_path(segment))
            if hashlib.sha256(content).hexdigest() != segment.sha256:
                raise ValueError(f"{segment.name} has changed since")
        prefixes = {}
        for name, (size, sha256) in _rows_under(checkpoint).items():
            path = self.ledger.folder / name
            content = self._intact_or_refused(path)[:size] if size or path.exists() else b""
            if len(content) < size:
                raise ValueError(f"{name} is shorter than it was")
            if hashlib.sha256(content).hexdigest() != sha256:
                raise ValueError(f"{name} has changed since")
            prefixes[name] = content
        return {**dict.fromkeys(ROW_FILES, b""), **prefixes}  # a file that is younger than the checkpoint holds nothing

    def _cut(self, prefixes: Mapping[str, bytes]) -> None:
        for name, content in prefixes.items():
            with appending(self.ledger.folder / name) as file:
                file.truncate(len(content))
                file.flush()
                os.fsync(file.fileno())
            self._sizes[name] = len(content)
            self._hashes[name] = hashlib.sha256(content)

    def append(self, name: str, row: Row) -> None:
        """Add a row; it counts once a checkpoint covers it. Raises RunLockedError if the run is no longer ours."""
        line = encode_row(row)
        with (
            _clear_errors(self.ledger.folder),
            self._lock.held(sign_of_life=False),
            appending(self.ledger.folder / name) as file,
        ):
            file.write(line)
        self._sizes[name] += len(line)
        self._hashes[name].update(line)

    def commit(self, checkpoint: Checkpoint, status: Status) -> None:
        """Make everything so far permanent. Raises RunLockedError if another process has taken the run over."""
        with _clear_errors(self.ledger.folder), self._lock.held():
            for name in ROW_FILES:
                with appending(self.ledger.folder / name) as file:
                    os.fsync(file.fileno())
            files = {name: (self._sizes[name], self._hashes[name].hexdigest()) for name in ROW_FILES}
            about = {
                "steps": status.steps, "identity": status.identity, "fingerprint": dict(status.fingerprint),
                "fingerprint_changed": status.fingerprint_changed,
            }  # fmt: skip
            data = {**checkpoint.data, "files": files, "about": about}
            content = encode_checkpoint(dataclasses.replace(checkpoint, data=data))
            path = self.ledger.checkpoints / f"round-{checkpoint.round:09d}.npz"
            atomic_write(path, content)
            self._write_status(
                dataclasses.replace(
                    status,
                    committed=dict(self._sizes),
                    checkpoint=path.name,
                    checkpoint_sha256=hashlib.sha256(content).hexdigest(),
                )
            )
            for old in self.ledger.checkpoint_files()[KEPT_CHECKPOINTS:]:
                old.unlink()
            self._named[path.name] = {segment.name for segment in checkpoint.segments}
            self._drop_unnamed_segments()

    def write_segment(self, first: int, count: int, arrays: Mapping[str, NDArray[Any]]) -> Segment:
        """Store a piece of a replay buffer; it counts once a checkpoint names it."""
        buffer = io.BytesIO()
        _savez(buffer, arrays)
        content = buffer.getvalue()
        segment = Segment(first, count, hashlib.sha256(content).hexdigest())
        with _clear_errors(self.ledger.folder), self._lock.held():
            self.ledger.replay.mkdir(exist_ok=True)
            atomic_write(self._segment_path(segment), content)
        return segment

    def read_segment(self, segment: Segment) -> dict[str, NDArray[Any]]:
        """The arrays of a piece whose checksum `restore` has verified. Raises LedgerError if it is damaged since."""
        path = self._segment_path(segment)
        try:
            return _decode_arrays(_read(path))
        except ValueError as error:
            raise LedgerError(f"{path} is damaged: {error}") from None

    def _drop_unnamed_segments(self) -> None:
        """Remove the pieces of replay buffers that no checkpoint names any more."""
        pieces = list(self.ledger.replay.glob("*.npz"))
        if not pieces:
            return
        kept = self.ledger.checkpoint_files()
        for file in kept:
            if file.name not in self._named:  # written before this process took the run over
                with contextlib.suppress(ValueError):
                    segments = decode_checkpoint(file.read_bytes()).segments
                    self._named[file.name] = {segment.name for segment in segments}
        self._named = {file.name: self._named.get(file.name, set()) for file in kept}
        named = set().union(*self._named.values())
        for piece in pieces:
            if piece.name not in named:
                piece.unlink()

    def _segment_path(self, segment: Segment) -> Path:
        return self.ledger.replay / segment.name

    def set_status(self, status: Status) -> None:
        """Write a new status that keeps what the last commit said about files."""
        if self.status is not None:
            status = dataclasses.replace(
                status,
                committed=self.status.committed,
                checkpoint=self.status.checkpoint,
                checkpoint_sha256=self.status.checkpoint_sha256,
            )
        with _clear_errors(self.ledger.folder), self._lock.held():
            self._write_status(status)

    def note_end(self, state: State, message: str) -> None:
        """Say why the process ends, from another thread than the one that works: over no newer status, and no end."""
        with _clear_errors(self.ledger.folder), self._lock.held():
            if self.status is not None and self.status.state == "running":
                self._write_status(
                    dataclasses.replace(self.status, state=state, message=message, updated_at=time.time())
                )  # fmt: skip

    def _write_status(self, status: Status) -> None:
        files = {**(self.status.files if self.status else {}), **self._files, **status.files}
        status = dataclasses.replace(status, files=files)
        data = dataclasses.asdict(status)
        crc = zlib.crc32(json.dumps(data, sort_keys=True).encode())
        atomic_write(self.ledger.status_file, json.dumps({**data, "crc": crc}, indent=1).encode())
        self.status = status

    def write_model(self, arrays: Mapping[str, NDArray[Any]], description: Mapping[str, Any]) -> None:
        """Store the trained policy as `model.npz` and `model.json`; the next status names their hashes."""
        buffer = io.BytesIO()
        _savez(buffer, arrays)
        model = {
            self.ledger.model_arrays: buffer.getvalue(),
            self.ledger.model_description: json.dumps(description, indent=1).encode(),
        }
        with _clear_errors(self.ledger.folder), self._lock.held():
            for path, content in model.items():
                atomic_write(path, content)
                self._files[path.name] = [hashlib.sha256(content).hexdigest()]


@contextlib.contextmanager
def _clear_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        _refuse(folder, error)


def _refuse(folder: Path, error: OSError) -> NoReturn:
    what = why_not_own(error) or {
        errno.ENOSPC: "the disk is full",
        errno.EDQUOT: "the disk quota is used up",
        errno.EROFS: "the file system is read-only",
        errno.EACCES: "permission denied",
        errno.ENOTDIR: "a part of the path is a file",
        errno.EEXIST: "a file of that name is in the way",
    }.get(error.errno or 0, error.strerror or str(error))
    raise LedgerError(
        f"cannot write to the run folder {folder}: {what}. What was committed is intact; "
        "once the cause is gone, --resume continues"
    ) from error


# ---- the lock -------------------------------------------------------------------------------------------------------


def this_process() -> dict[str, Any]:
    """Who we are, so that anyone can tell whether we still live: host, boot, namespace, pid, and when it started."""
    return process_of(os.getpid())


def process_of(pid: int) -> dict[str, Any]:
    """The same of another process of our namespace."""

    def read(path: str) -> str:
        try:
            return Path(path).read_text().strip()
        except OSError:
            return ""

    try:
        pid_namespace = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        pid_namespace = ""
    return {
        "host": socket.gethostname(),
        "boot_id": read("/proc/sys/kernel/random/boot_id"),
        "pid_namespace": pid_namespace,
        "pid": pid,
        "started": _started(pid),
    }


def believed_alive(owner: Mapping[str, Any]) -> bool:
    """Look the owner up where its processes can be seen from here; else believe its last heartbeat for a lease."""
    if not owner or owner.get("released"):
        return False
    here = this_process()
    same_kernel = here["boot_id"] and owner.get("boot_id") == here["boot_id"]
    if same_kernel and owner.get("pid_namespace") == here["pid_namespace"]:
        pid, started = owner.get("pid"), owner.get("started")
        return isinstance(pid, int) and started is not None and _started(pid) == started
    try:
        return abs(time.time() - float(owner["heartbeat"])) < LEASE_SECONDS  # clocks of two hosts differ
    except (KeyError, ValueError, TypeError, OverflowError):
        return False


def _started(pid: int) -> int | None:
    """When a living process began, in clock ticks since boot: unlike a time of day, no clock setting changes it."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    return None if fields[0] == b"Z" else int(fields[19])


class Lock:
    """Ownership of a run, in a file whose every reading and writing happens under `flock`.

    Only the process that made this object can use it; what was forked from that process is told so.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._me, self._pid = this_process(), os.getpid()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._turn = threading.Lock()  # our threads wait for each other as long as it takes, for others they do not

    @contextlib.contextmanager
    def _locked_file(self, seconds: float) -> Iterator[io.BufferedRandom]:
        with self._turn, locked(self._path, seconds) as file:
            yield file

    def _read(self, file: io.BufferedRandom) -> dict[str, Any]:
        file.seek(0)
        return _decoded_owner(file.read(_MAX_STATUS_BYTES))

    def _write(self, file: io.BufferedRandom, **extra: Any) -> None:
        content = json.dumps({**self._me, "heartbeat": time.time(), **extra}).encode()
        file.seek(0)
        file.write(content)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())

    def _is_mine(self, owner: Mapping[str, Any]) -> bool:
        return not owner.get("released") and all(owner.get(key) == value for key, value in self._me.items())

    def acquire(self) -> None:
        """Become the owner. Raises RunLockedError if somebody else is, or does not let go of the file."""
        try:
            with self._locked_file(CLAIM_SECONDS) as file:
                self._claim(file)
        except TimeoutError as error:
            with contextlib.suppress(OSError):
                self._refuse(_owner(self._path), f", and has been in the middle of a write for {CLAIM_SECONDS:.0f} s")
            raise RunLockedError(f"cannot claim {self._path.parent}: {error.strerror}") from None
        self._thread = threading.Thread(target=self._beat, name="lock-heartbeat", daemon=True)
        self._thread.start()

    def _claim(self, file: io.BufferedRandom) -> None:
        self._refuse(self._read(file))
        try:
            self._write(file)
        except OSError:  # a claim that may not be on disk is none: whoever tries again must not meet it
            with contextlib.suppress(OSError):
                file.truncate(0)
            raise

    def _refuse(self, owner: Mapping[str, Any], more: str = "") -> None:
        if believed_alive(owner):
            raise RunLockedError(
                f"{self._path.parent} is being worked on by process {owner.get('pid')} on {owner.get('host')}{more}. "
                "Wait for it to end, or stop it; if it is on a machine that died, its claim ends "
                f"{LEASE_SECONDS:.0f} s after its last sign of life"
            )

    def _beat(self) -> None:
        while not self._stop.wait(HEARTBEAT_SECONDS):
            # A disk that is full for a moment must not end the thread: the next beat, or the commit, will tell.
            with contextlib.suppress(OSError, RunLockedError), self.held():
                pass

    @contextlib.contextmanager
    def held(self, *, sign_of_life: bool = True) -> Iterator[None]:
        """Do something that only the owner may do. Raises RunLockedError if that is no longer us, or never was."""
        if self._forked:
            raise RunLockedError(
                f"{self._path.parent} is process {self._pid}'s; this process, {os.getpid()}, is a copy of it, "
                "forked by the environment or by a library, and changes nothing"
            )
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(self._locked_file(OWNER_SECONDS))
            except TimeoutError as error:
                raise RunLockedError(
                    f"cannot write to {self._path.parent}: {error.strerror}. What was committed is intact; once the "
                    "lock is free, --resume continues"
                ) from None
            owner = self._read(file)
            if not self._is_mine(owner):
                who = f"process {owner.get('pid')} on {owner.get('host')}" if owner.get("host") else "somebody else"
                what = f"taken over by {who}" if owner else f"given up: {self._path.name} was removed or damaged"
                raise RunLockedError(f"{self._path.parent} was {what}; this process stops and changes nothing more")
            if sign_of_life:  # which costs a write to disk
                self._write(file)
            yield

    @property
    def _forked(self) -> bool:
        return os.getpid() != self._pid

    def release(self) -> None:
        """Give it up, if it is ours."""
        if self._forked:
            return
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            with contextlib.suppress(OSError), self._locked_file(OWNER_SECONDS) as file:
                if self._is_mine(self._read(file)):
                    self._write(file, released=True)
