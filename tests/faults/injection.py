"""Faults for runs: what a kill at any system call would leave behind, and disks that refuse."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

UNCOMPARED = ("lock.json", "log.txt")


class Disk:
    """Watches every call that changes something below a folder: `before(n, what)` comes before the n-th of them.

    A write is two calls, so that there is a moment at which half of it is there. What `before` raises, the call raises.
    """

    def __init__(self, folder: Path, before: Callable[[int, str], None]) -> None:
        self._folder, self._before, self.calls = str(folder), before, 0

    @contextmanager
    def watched(self) -> Iterator[Disk]:
        """For this process, until the end of the block; nothing is forced to disk within it."""
        originals = {name: getattr(os, name) for name in ("replace", "unlink", "mkdir", "open", "fsync", "fdopen")}
        open_path = Path.open

        def told(name: str) -> Callable[..., Any]:
            def call(path: Any, *rest: Any, **named: Any) -> Any:
                if str(path).startswith(self._folder):
                    self.tell(f"{name} {Path(path).name}")
                return originals[name](path, *rest, **named)

            return call

        def opened(path: Path, mode: str = "r", *rest: Any, **named: Any) -> Any:
            file = open_path(path, mode, *rest, **named)
            watched = mode in ("wb", "ab") and str(path).startswith(self._folder)
            return _File(file, self, path.name) if watched else file

        for name in ("replace", "unlink", "mkdir", "open"):
            setattr(os, name, told(name))
        os.fsync = lambda descriptor: self.tell("fsync")  # type: ignore[assignment] # who is killed loses nothing
        os.fdopen = lambda *args: _File(originals["fdopen"](*args), self, "lock.json")  # type: ignore[assignment]
        Path.open = opened  # type: ignore[method-assign, assignment]
        try:
            yield self
        finally:
            for name, original in originals.items():
                setattr(os, name, original)
            Path.open = open_path  # type: ignore[method-assign]

    def tell(self, what: str) -> None:
        self.calls += 1
        self._before(self.calls, what)


class _File:
    def __init__(self, file: Any, disk: Disk, name: str) -> None:
        self._file, self._disk, self._name = file, disk, name

    def write(self, content: bytes) -> None:
        for part in (content[: len(content) // 2], content[len(content) // 2 :]):
            self._disk.tell(f"write {self._name}")
            self._file.write(part)
            self._file.flush()

    def truncate(self, *size: int) -> None:
        self._disk.tell(f"truncate {self._name}")
        self._file.truncate(*size)

    def fileno(self) -> int:
        return int(self._file.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


class Kills:
    """Keeps what a kill at each call would leave behind: a copy of the folder wherever it differs from the last.

    uncompared: names of files that make no difference.
    """

    def __init__(self, folder: Path, kept: Path, uncompared: Sequence[str] = UNCOMPARED) -> None:
        self._folder, self._kept, self._uncompared, self._last = folder, kept, uncompared, ""
        self.moments: list[tuple[str, Path]] = []  # before what, and the copy

    def __call__(self, number: int, what: str) -> None:
        digest = hashlib.sha256()
        for path in sorted(self._folder.rglob("*")):
            content = path.read_bytes() if path.is_file() and path.name not in self._uncompared else b""
            digest.update(f"{path.relative_to(self._folder)} {len(content)} ".encode() + content)
        if digest.hexdigest() == self._last:
            return
        self._last = digest.hexdigest()
        copy = self._kept / f"{number:05d}"
        shutil.copytree(self._folder, copy)
        bury_owner(copy)
        self.moments.append((what, copy))


def bury_owner(folder: Path) -> None:
    """As if the process that owned a run had died without a word: another one bears its number now."""
    lock = folder / "lock.json"
    try:
        owner = json.loads(lock.read_bytes())
    except (OSError, ValueError):
        return
    lock.write_text(json.dumps({**owner, "started": owner["started"] - 1}))
