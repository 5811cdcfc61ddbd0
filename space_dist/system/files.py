"""Files of ours in folders where others may have been before us: written through no link, locked with bounded waits.

A file that we append to is a regular file with one name. A symbolic link, a hard link, a pipe or a device in its place
would carry what we write somewhere else; files that are written whole are renamed into place, which replaces any link.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import logging
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

_TEMPORARY = ".{}.tmp"
TEMPORARIES = _TEMPORARY.format("*")
_LOOK_SECONDS = 0.02  # between looks at a lock that another process holds
_NO_FILE_OF_ITS_OWN = {
    errno.ELOOP: "is a link",
    errno.EMLINK: "has a second name (a hard link)",
    errno.ENXIO: "is no regular file",
}


def open_own(path: Path, flags: int, mode: int = 0o666) -> int:
    """A descriptor of a regular file that has this name alone, made if `flags` hold O_CREAT.

    Raises OSError: ELOOP for a symbolic link, EMLINK for a second name, ENXIO for what is no file.
    """
    # Without O_NONBLOCK, opening a pipe waits for somebody at its other end; regular files do not heed it.
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, mode)
    about = os.fstat(descriptor)
    number = 0 if stat.S_ISREG(about.st_mode) else errno.ENXIO
    if about.st_nlink > 1:
        number = errno.EMLINK
    if number:
        os.close(descriptor)
        raise OSError(number, os.strerror(number), str(path))
    return descriptor


def own_folder(path: Path) -> None:
    """Make a folder of ours, unless it is there. Raises OSError: ELOOP for a link, which leads into somebody else's."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    path.mkdir(exist_ok=True)


def appending(path: Path) -> io.BufferedWriter:
    """The file, made if need be, for writing at its end. Raises OSError as `open_own`."""
    return os.fdopen(open_own(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "ab")


def read_file(path: Path, limit: int = -1) -> bytes:
    """A regular file's content, `limit` bytes at most. Raises OSError: ENXIO for a pipe, which would have us wait."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.ENXIO, _NO_FILE_OF_ITS_OWN[errno.ENXIO], str(path))
        return file.read(limit)


def why_not_own(error: OSError) -> str | None:
    """What is wrong with the file that `open_own` refused, in words; None if it was something else."""
    what = _NO_FILE_OF_ITS_OWN.get(error.errno or 0)
    if what is None or error.filename is None:
        return None
    return f"{Path(error.filename).name} {what}, and what is written would land elsewhere; remove it"


def in_words(error: OSError) -> str:
    """Why a file cannot be written."""
    return why_not_own(error) or error.strerror or str(error)


def atomic_write(path: Path, content: bytes) -> None:
    """Write a whole file or nothing, and be sure that it is on disk."""
    temporary = path.with_name(_TEMPORARY.format(path.name))
    with os.fdopen(open_own(temporary, os.O_WRONLY | os.O_CREAT), "wb") as file:
        file.truncate(0)  # only now: a link's target would have been emptied
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    # rename(2) is atomic: readers see the old file or the new one.
    temporary.replace(path)
    # A rename is on disk once its folder is (fsync(2)).
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def locked(path: Path, seconds: float) -> Iterator[io.BufferedRandom]:
    """Hold a file's lock, which the system takes back from whoever dies; waits for others, but so long at most.

    Who may open a file may lock it, so only its owner's user may. Raises TimeoutError if another process held the lock
    all the time, OSError as `open_own`.
    """
    descriptor = open_own(path, os.O_RDWR | os.O_CREAT, 0o600)
    with os.fdopen(descriptor, "r+b") as file:
        if os.fstat(file.fileno()).st_mode & 0o077:
            with contextlib.suppress(OSError):  # another user's: the wait is bounded all the same
                os.fchmod(file.fileno(), 0o600)
        until = time.monotonic() + seconds
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until:
                    what = f"another process has held its lock for {seconds:.0f} s (`fuser -v {path}` names it)"
                    raise TimeoutError(errno.ETIMEDOUT, what, str(path)) from None
            time.sleep(_LOOK_SECONDS)
        try:
            yield file
        finally:
            # By hand, since closing does not suffice: a process that was forked meanwhile has the descriptor, too.
            fcntl.flock(file, fcntl.LOCK_UN)


class LogFile(logging.FileHandler):
    """A log file that is written through no link. Raises OSError as `open_own`."""

    def _open(self) -> io.TextIOWrapper:
        descriptor = open_own(Path(self.baseFilename), os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        return io.TextIOWrapper(io.BufferedWriter(io.FileIO(descriptor, "a")), encoding="utf-8")

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Nothing: what cannot be logged ends nothing; on a full disk, whoever cannot write what matters says so."""
