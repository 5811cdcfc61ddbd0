"""Who owns a folder: one live process at a time, as far as can be told from any machine."""

from __future__ import annotations

import contextlib
import io
import json
import os
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from space_dist.errors import CONTINUES, RunLockedError
from space_dist.system.files import locked, read_file

LEASE_SECONDS = 120.0  # how long an owner that cannot be seen from here is believed to live after its last sign
HEARTBEAT_SECONDS = 10.0  # between signs of an owner: a dozen may be lost before the lease is over
CLAIM_SECONDS = 10.0  # for a lock that another process holds; it does so while it writes
OWNER_SECONDS = 60.0  # the same for the owner, whose run ends then
_MAX_OWNER_BYTES = 1 << 20


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
        # The start tells a process from a later one with the same number.
        return isinstance(pid, int) and started is not None and _started(pid) == started
    try:
        return abs(time.time() - float(owner["heartbeat"])) < LEASE_SECONDS  # clocks of two hosts differ
    except (KeyError, ValueError, TypeError, OverflowError):
        return False


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
    return _decoded_owner(read_file(lock_file, _MAX_OWNER_BYTES))


def _decoded_owner(content: bytes) -> dict[str, Any]:
    try:
        owner = json.loads(content or b"{}")
    except (ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _started(pid: int) -> int | None:
    """When a living process began, in clock ticks since boot: unlike a time of day, no clock setting changes it."""
    try:
        # Behind the last parenthesis: a command's name, which stands in parentheses, may hold some itself (proc(5)).
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    # A zombie works on nothing. Field 22 of the file, `starttime`, is the 20th behind the name.
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
        return _decoded_owner(file.read(_MAX_OWNER_BYTES))

    def _write(self, file: io.BufferedRandom, **extra: Any) -> None:
        content = json.dumps({**self._me, "heartbeat": time.time(), **extra}).encode()
        file.seek(0)
        file.write(content)
        file.truncate()
        file.flush()
        # Others decide by what is on disk, on other hosts as well.
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
                    f"lock is free, {CONTINUES}"
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
            # Else a beat that is under way would write the claim anew behind the release.
            self._thread.join()
            with contextlib.suppress(OSError), self._locked_file(OWNER_SECONDS) as file:
                if self._is_mine(self._read(file)):
                    self._write(file, released=True)
