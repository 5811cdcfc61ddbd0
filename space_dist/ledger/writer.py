"""A run's folder, for its owner: rows, checkpoints and the status, in an order that a kill cannot break."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import logging
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from numpy.typing import NDArray

from space_dist.errors import CONTINUES, LedgerError, UnreadableError
from space_dist.ledger.checkpoint import (
    Checkpoint,
    Segment,
    decode_arrays,
    decode_checkpoint,
    encode_arrays,
    encode_checkpoint,
    rows_under,
)
from space_dist.ledger.folder import Ledger, State, Status, read_whole
from space_dist.ledger.lock import Lock
from space_dist.ledger.rows import ROW_FILES, Row, encode_row
from space_dist.system.files import TEMPORARIES, appending, atomic_write, own_folder, read_file, why_not_own

log = logging.getLogger("space_dist")
KEPT_CHECKPOINTS = 2  # one more than is needed: the newest may turn out to be damaged


@dataclasses.dataclass(frozen=True)
class _Restorable:
    """A checkpoint that fits what is there: what it holds, the rows under it, and why newer ones do not."""

    file: Path
    content: bytes
    checkpoint: Checkpoint
    prefixes: dict[str, bytes]
    reasons: list[str]


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
                own_folder(self.ledger.checkpoints)
                if self.ledger.replay.exists():
                    own_folder(self.ledger.replay)
                for folder in (self.ledger.folder, self.ledger.checkpoints, self.ledger.replay):
                    for left_behind in folder.glob(TEMPORARIES):  # by a process that was killed while it wrote
                        left_behind.unlink()
            except BaseException:
                # `with` calls no `__exit__` for what fails in `__enter__`.
                self._lock.release()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    @property
    def current(self) -> Status:
        """The status as it was last written. Raises RuntimeError before there is one."""
        if self.status is None:
            raise RuntimeError("the run has no status yet")
        return self.status

    def write_config(
        self, config: str, train: str, test: str, given: Mapping[str, bytes] = MappingProxyType({})
    ) -> None:
        """Record what was asked for. The config comes last: a folder that has one is complete.

        given: what was taken from other runs, by the key that names it.
        Where there is a status, it names both the old and the new content until the next one is written.
        """
        asked = {
            self.ledger.instances("train"): train.encode(),
            self.ledger.instances("test"): test.encode(),
            **{self.ledger.given[key]: content for key, content in given.items()},
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

    def hand_over(self, status: Status, config: str, keep: Callable[[Checkpoint], bool]) -> Status:
        """Make this a run of another identity, `status.identity`: the checkpoints that `keep` are its own from now on.

        The others are forgotten. Returns where it stands then. Interrupted at any moment, it can be done again.
        `config` is to be written next, by `write_config`; until then the status names its hash and the old one's.
        """
        with _clear_errors(self.ledger.folder), self._lock.held():
            newest: Path | None = None
            forgotten = []
            for file in self.ledger.checkpoint_files():
                try:
                    checkpoint = decode_checkpoint(self._intact_or_refused(file))
                except ValueError:
                    continue  # `restore` says so
                if not keep(checkpoint):
                    forgotten.append(file)
                    continue
                about = {**checkpoint.data.get("about", {}), "identity": status.identity}
                content = encode_checkpoint(dataclasses.replace(checkpoint, data={**checkpoint.data, "about": about}))
                atomic_write(file, content)
                if newest is None:
                    newest = file
                    sizes = {name: size for name, (size, _) in rows_under(checkpoint).items()}
                    status = dataclasses.replace(
                        status, round=checkpoint.round, steps=about.get("steps", 0), committed=sizes,
                        checkpoint=file.name, checkpoint_sha256=hashlib.sha256(content).hexdigest(),
                    )  # fmt: skip
            if newest is None:
                status = dataclasses.replace(
                    status, round=0, steps=0, committed={}, checkpoint=None, checkpoint_sha256=None
                )  # fmt: skip
            files = {} if self.status is None else self.status.files
            name = self.ledger.config.name
            both = sorted({*files.get(name, []), hashlib.sha256(config.encode()).hexdigest()})
            self._write_status(dataclasses.replace(status, files={**status.files, name: both}))
            # Behind the status, which no longer names them.
            for file in forgotten:
                file.unlink()
        return status

    def refuse_unrestorable(
        self, keep: Callable[[Checkpoint], bool] = lambda checkpoint: True, also: str | None = None
    ) -> None:
        """Raise what `restore` would raise, while nothing is written yet.

        keep, also: before `hand_over`, what it is given, and the identity that it gives: interrupted, it may have given
        that to some.
        """
        self._restorable(keep, also)

    def restore(self) -> Checkpoint | None:
        """Cut every row file back to the newest intact checkpoint and return it; to nothing where none was written.

        Raises LedgerError, and changes nothing, if something cannot be read that may be intact, and UnreadableError if
        there are checkpoints but none fits what is there, or if the status names one but there is none.
        """
        found = self._restorable()
        files = self.ledger.checkpoint_files()
        if found is None:
            with _clear_errors(self.ledger.folder), self._lock.held():
                self._cut(dict.fromkeys(ROW_FILES, b""))
                for forgotten in files:
                    forgotten.unlink()
            return None
        if found.reasons:
            reasons = "; ".join(found.reasons)
            log.warning("going back to the checkpoint of round %d (%s)", found.checkpoint.round, reasons)
        with _clear_errors(self.ledger.folder), self._lock.held():
            # In this order: a kill in between leaves a status whose checkpoint and rows are there.
            self._point_at(found.file.name, found.content, found.checkpoint)
            self._cut(found.prefixes)
            for newer in files[: files.index(found.file)]:
                newer.unlink()
        return found.checkpoint

    def _restorable(
        self, keep: Callable[[Checkpoint], bool] = lambda checkpoint: True, also: str | None = None
    ) -> _Restorable | None:
        """The newest intact checkpoint that `keep` keeps; None where none was written. Raises as `restore` does."""
        files = self.ledger.checkpoint_files()
        named = None if self.status is None else self.status.checkpoint
        reasons = [f"{named}: missing"] if named is not None and (not files or files[0].name < named) else []
        needed = "no checkpoint"
        for file in files:
            try:
                content = self._intact_or_refused(file)
                checkpoint = decode_checkpoint(content)
                if not keep(checkpoint) or self._is_forgotten(checkpoint):
                    needed = "no checkpoint that it could go on from"
                    continue
                prefixes = self._verified_prefixes(checkpoint, also)
            except ValueError as error:
                reasons.append(f"{file.name}: {error}")
                continue
            return _Restorable(file, content, checkpoint, prefixes, reasons)
        if reasons:
            raise UnreadableError(
                f"{self.ledger.folder} cannot be resumed: {needed} is intact ({'; '.join(reasons)}). "
                "Nothing was changed; start the run in another folder"
            )
        return None

    def _is_forgotten(self, checkpoint: Checkpoint) -> bool:
        """Whether it is what a `hand_over` that kept none, and was then interrupted, had not removed yet."""
        theirs = checkpoint.data.get("about", {}).get("identity")
        if self.status is None or self.status.checkpoint is not None:
            return False
        return self.status.round == 0 and None not in (theirs, self.status.identity) and theirs != self.status.identity

    def _intact_or_refused(self, path: Path) -> bytes:
        """A file's content. Raises ValueError if it is gone, LedgerError if it may be intact but cannot be read now."""
        try:
            return read_file(path)
        except FileNotFoundError:
            raise ValueError(f"{path.name} is missing") from None
        except OSError as error:
            raise LedgerError(
                f"{self.ledger.folder} cannot be resumed now: {path} cannot be read ({error.strerror}). "
                "Nothing was changed; once the cause is gone, " + CONTINUES
            ) from error

    def _point_at(self, name: str, content: bytes, checkpoint: Checkpoint) -> None:
        """Let the status name the checkpoint that is used, before another one that it may name is removed."""
        sizes = {file: size for file, (size, _) in rows_under(checkpoint).items()}
        if self.status is None or (self.status.checkpoint, self.status.committed) == (name, sizes):
            return
        self._write_status(
            dataclasses.replace(
                self.status, round=checkpoint.round, steps=checkpoint.data.get("about", {}).get("steps", 0),
                committed=sizes, checkpoint=name, checkpoint_sha256=hashlib.sha256(content).hexdigest(),
            )
        )  # fmt: skip

    def _verified_prefixes(self, checkpoint: Checkpoint, also: str | None = None) -> dict[str, bytes]:
        theirs = checkpoint.data.get("about", {}).get("identity")
        ours = None if self.status is None else self.status.identity
        if theirs not in (ours, also) and None not in (theirs, ours):
            raise ValueError("it belongs to a run of another configuration")
        for segment in checkpoint.segments:
            content = self._intact_or_refused(self._segment_path(segment))
            if hashlib.sha256(content).hexdigest() != segment.sha256:
                raise ValueError(f"{segment.name} has changed since")
        prefixes = {}
        for name, (size, sha256) in rows_under(checkpoint).items():
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
        # Kept up row by row: hashing whole files at every commit would cost more, the longer a run is.
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
            # Rows, checkpoint, status: each names only what is on disk before it.
            atomic_write(path, content)
            self._write_status(
                dataclasses.replace(
                    status,
                    committed=dict(self._sizes),
                    checkpoint=path.name,
                    checkpoint_sha256=hashlib.sha256(content).hexdigest(),
                )
            )
            # Last: until the status names the new one, the one before it is what a killed run goes on from.
            for old in self.ledger.checkpoint_files()[KEPT_CHECKPOINTS:]:
                old.unlink()
            self._named[path.name] = {segment.name for segment in checkpoint.segments}
            self._drop_unnamed_segments()

    def write_segment(self, first: int, count: int, arrays: Mapping[str, NDArray[Any]]) -> Segment:
        """Store a piece of a replay buffer; it counts once a checkpoint names it."""
        content = encode_arrays(arrays)
        segment = Segment(first, count, hashlib.sha256(content).hexdigest())
        with _clear_errors(self.ledger.folder), self._lock.held():
            own_folder(self.ledger.replay)
            atomic_write(self._segment_path(segment), content)
        return segment

    def read_segment(self, segment: Segment) -> dict[str, NDArray[Any]]:
        """The arrays of a piece whose checksum `restore` has verified. Raises LedgerError if it is damaged since."""
        path = self._segment_path(segment)
        try:
            return decode_arrays(read_whole(path))
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
                with contextlib.suppress(ValueError, LedgerError):
                    segments = decode_checkpoint(read_whole(file)).segments
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
        model = {
            self.ledger.model_arrays: encode_arrays(arrays),
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
    left = "Nothing was begun there"
    if os.access(folder / "status.json", os.F_OK):  # False as well where it cannot be told
        left = f"What was committed is intact; once the cause is gone, {CONTINUES}"
    raise LedgerError(f"cannot write to the run folder {folder}: {what}. {left}") from error
