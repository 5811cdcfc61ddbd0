"""A run's folder, for reading: where its files are, and whether they are as they were written."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Literal

from space_dist.errors import LedgerError, NotPlannedError, below, missing_folder, nearest
from space_dist.ledger.checkpoint import FORMAT, READABLE, Checkpoint, decode_checkpoint
from space_dist.ledger.lock import owner_alive
from space_dist.ledger.rows import METRICS, ROW_FILES, Row, decode_row
from space_dist.system.files import read_file

State = Literal["running", "interrupted", "failed", "paused", "done"]
_MAX_STATUS_BYTES = 1 << 20
_CHECKPOINT = re.compile(r"round-[0-9]{9,12}\.npz")
GOES_BACK: Final = "`train --resume` goes back to the one before it"  # behind a damaged checkpoint, where that can be
_READINGS = 3  # of a file and the status that names it, which a live writer may be replacing


@dataclasses.dataclass(frozen=True)
class Status:
    """`status.json`. Steps are real environment steps of training; times are seconds since the epoch.

    paused_at: of a run that is paused, the steps at which it was asked to be; 0 for any other.  format: of its files; 2
    is what this version writes.
    """

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
    paused_at: int = 0
    format: int = FORMAT

    def has_reached(self, pause_at: int) -> bool:
        """Whether there is nothing left to do: it is done, or paused where it was asked to be (0: nowhere)."""
        return self.state == "done" or (self.state == "paused" and 0 < pause_at <= self.paused_at)

    def is_final(self, evaluated_at: int) -> bool:
        """Whether an evaluation after so many steps tells a run's final numbers: of the policy it finished with."""
        return self.state == "done" and bool(evaluated_at == self.steps)


GIVEN: Final = {"init_from": "init.npz", "curriculum.of": "recorded.npz"}


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
        # What was taken from other runs, by the key that names it.
        self.given = {key: self.folder / name for key, name in GIVEN.items()}
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
        """Read `status.json`. Raises LedgerError if it is lost or damaged, NotPlannedError where no run was begun."""
        try:
            content = read_file(self.status_file, _MAX_STATUS_BYTES + 1)
        except FileNotFoundError:
            if not self.folder.exists():
                raise NotPlannedError(absent(self.folder)) from None
            kind = LedgerError if self.config.exists() else NotPlannedError
            raise kind(f"{self.folder} holds no run: it has no status.json{_below(self.folder)}") from None
        except NotADirectoryError:
            raise NotPlannedError(f"{self.folder} is no run's folder: {_file_in(self.folder)} is a file") from None
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
            # A status may be a stranger's: `../x` would have files outside of the folder read.
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
            content = read_whole(path, missing=b"")
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

    def episodes(self) -> int:
        """Training episodes that ended, by the iterations that are written. Raises LedgerError as `rows` does."""
        return sum(int(row["episodes"]) for row in self.rows() if row["kind"] == "iteration")

    def read(self, path: Path) -> bytes:
        """A file of the run that is written whole (config, instances, model), as its writer left it.

        Raises LedgerError if it is missing, cannot be read, or is not what `status.json` says it is.
        """
        for _ in range(_READINGS):
            content = read_whole(path)
            known = self.status().files.get(path.name)
            if known is None or hashlib.sha256(content).hexdigest() in known:
                return content
        raise LedgerError(f"{path} is damaged: its checksum is not the one that status.json names")

    def damage(self) -> list[str]:
        """What of a run's results and of what it was asked is no longer as `status.json` says, one sentence each."""
        checks: list[Callable[[], object]] = [
            functools.partial(self.read, self.folder / name) for name in self.status().files
        ]
        done = self.status().state == "done"  # of whose rows a checkpoint covers all
        checks += [functools.partial(self.rows, name, committed_only=not done) for name in ROW_FILES]
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
                return decode_checkpoint(read_whole(self.checkpoints / name))
            name = self.status().checkpoint
        if name is None:
            return None
        what = "damaged" if (self.checkpoints / name).exists() else "missing"
        way_out = GOES_BACK if self.has_intact_checkpoint() else "no other is intact"
        raise LedgerError(f"the last checkpoint in {self.checkpoints}, {name}, is {what}; {way_out}")

    def has_intact_checkpoint(self) -> bool:
        """Whether one at least can be read, whichever `status.json` names."""
        for file in self.checkpoint_files():
            with contextlib.suppress(LedgerError, ValueError):
                decode_checkpoint(read_whole(file))
                return True
        return False

    def abandoned(self, status: Status) -> bool:
        """Whether the run was left behind by a process that is gone, and could not say why."""
        return status.state == "running" and not self.owner_alive()

    def owner_alive(self) -> bool:
        """Whether a live process works on this run now, as far as can be told from this machine."""
        return owner_alive(self.lock_file)


def absent(folder: Path, otherwise: str = "") -> str:
    """What to say of a folder that is not there, with the nearest name beside it, or beside a folder on the way to it.

    otherwise: a clause for where there is no such hint.
    """
    hint = missing_folder(folder) or nearest(folder.name, (other.name for other in folder.parent.glob("*/")))
    return f"{folder} does not exist{hint.removesuffix('.') or otherwise}"


def _file_in(path: Path) -> str:
    """What of a path is a file, where a folder was expected: `it`, or the part that is."""
    part = next((above for above in path.parents if above.is_file()), None)
    return "it" if part is None else str(part)


def _below(folder: Path) -> str:
    """Which runs to name instead of a folder that holds none itself: its own, or, of a grid, those of its cells."""
    found = sorted([*folder.glob("*/status.json"), *folder.glob("*/*/status.json")])
    return below([file.parent for file in found])


def there(path: Path) -> Path:
    """The path that a user names as a run's, or as one that holds some. Raises NotPlannedError where nothing is."""
    if not path.exists():
        raise NotPlannedError(absent(path.absolute()))
    return path


def find_ledgers(paths: list[Path]) -> list[Ledger]:
    """Every run in or below `paths`, sorted by path, each once.

    Raises NotPlannedError where there is none.
    """
    found: dict[Path, Ledger] = {}
    for path in map(there, paths):
        below = [Ledger(path)] if (path / "status.json").exists() else []
        below += [Ledger(file.parent) for file in path.rglob("status.json") if path.is_dir()]
        if not below:
            raise NotPlannedError(f"no run found in {path}: no folder there has a status.json")
        found |= {ledger.folder.resolve(): ledger for ledger in below}
    return [found[key] for key in sorted(found)]


def read_whole(path: Path, *, missing: bytes | None = None) -> bytes:
    """A file's content; `missing`, if given, where there is none. Raises LedgerError if that cannot be had."""
    try:
        return read_file(path)
    except FileNotFoundError:
        if missing is not None:
            return missing
        raise LedgerError(f"{path.parent} is incomplete: it has no {path.name}") from None
    except OSError as error:
        raise LedgerError(f"{path} cannot be read: {error.strerror}") from None
