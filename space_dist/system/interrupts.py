"""Being asked to stop: signals and a flag file. Imports nothing heavy, so that handlers stand before anything else."""

from __future__ import annotations

import atexit
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Final

from space_dist.errors import Interrupted

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
_COARSE_SECONDS: Final = 1.0  # between two times of a file, where they are whole seconds
_FINE_SECONDS: Final = 0.05  # elsewhere: the kernel's clock for files goes by ticks


def _settle() -> None:
    """Once the exit code is decided, Python takes its handlers down: what came then would end the process its way."""
    for number in (signal.SIGTERM, signal.SIGUSR1):  # and not SIGINT, should the end hang
        signal.signal(number, signal.SIG_IGN)


def _process_start() -> float:
    """When this process was started, as Unix time, to some hundredths of a second; now, where that is not known."""
    try:
        # Field 22, in ticks since the machine's start: the names before it may hold spaces.
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        age = 0.0
    return time.time() - max(0.0, age)


class StopRequests:
    """Remembers the first request to stop; a run asks for it between rounds.

    If the run does not get there within `grace_seconds` of the signal, the process ends on its last checkpoint, with
    the same exit code. A second SIGINT ends it at once.
    """

    def __init__(self, shared: StopRequests | None = None, tell: Callable[[str], None] = lambda sentence: None) -> None:
        """shared: whose signals also ask this one; its file does not.  tell: where somebody waits for an answer.

        `tell` is called by signal handlers and threads.
        """
        self._shared, self._tell = shared, tell
        self._reason: str | None = None
        self._file: Path | None = None
        self._grace_seconds = 25.0
        self._installed = False
        self._instead = ""
        self._over: str | None = None
        self._since = time.time()

    def install(self, instead: str = "") -> None:
        """Set the handlers, of a process that is there for what may be stopped: it is heard from its start on.

        instead: what a signal has it do, where that is not a checkpoint.
        """
        self._instead = instead or self._instead
        if not self._installed:
            self._installed, self._since = True, _process_start()
            atexit.register(_settle)  # before anybody else's, so it comes last
        for number in STOP_SIGNALS:
            signal.signal(number, self._on_signal)

    @contextmanager
    def keeping_handlers(self) -> Iterator[None]:
        """Keep the handlers, if they are set, while something runs that replaces them: `ray.init`, for seconds."""
        if not self._installed:
            yield
            return
        replace = signal.signal

        def keep_ours(number: int, handler: Any) -> Any:
            return signal.getsignal(number) if number in STOP_SIGNALS else replace(number, handler)

        # `ray.init` replaces SIGTERM's handler; what came in these seconds would end the process its way.
        signal.signal = keep_ours  # type: ignore[assignment]
        try:
            yield
        finally:
            signal.signal = replace
            self.install()

    @contextmanager
    def nothing_left(self, instead: str) -> Iterator[Callable[[], bool]]:
        """While all work is done, and something else is waited for: a first signal ends the waiting, and no process.

        instead: what it does, in words. Yields whether one has come.
        """
        root = self if self._shared is None else self._shared
        before, root._over = root._reason, instead
        try:
            yield lambda: root._reason is not before
        finally:
            root._over = None

    def watch(self, stop_file: Path, grace_seconds: float) -> None:
        """Also stop once `stop_file` exists."""
        self._file, self._grace_seconds = stop_file, grace_seconds
        if self._shared is not None:
            self._shared._grace_seconds = grace_seconds

    def sweep(self, stop_file: Path) -> bool:
        """Remove a `stop_file` that is older than this, and so asked somebody before; whether there was one."""
        since = self._since if self._shared is None else self._shared._since
        try:
            written = stop_file.stat()
        except FileNotFoundError:
            return False
        whole = written.st_mtime_ns % 1_000_000_000 == 0
        if written.st_mtime > since - (_COARSE_SECONDS if whole else _FINE_SECONDS):
            return False
        stop_file.unlink(missing_ok=True)
        return True

    @property
    def signalled(self) -> str | None:
        """The signal that asked to stop, if one did."""
        return self._reason if self._shared is None else self._shared.signalled

    @property
    def filed(self) -> str | None:
        """The file that asks to stop, if it is there."""
        return f"the file {self._file}" if self._file is not None and self._file.exists() else None

    def reason(self) -> str | None:
        """Why to stop, or None."""
        if self._shared is not None and self._reason is None:
            self._reason = self._shared.signalled
        if self._reason is None:
            self._reason = self.filed
        return self._reason

    def _on_signal(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - the signature is Python's
        if self._reason is None and self._over is not None:
            self._reason = signal.Signals(number).name
            self._tell(f"{self._reason}: {self._over}")
            return
        if self._reason is not None:
            if number == signal.SIGINT:
                where = "" if self._instead else ", on the last checkpoint that there is"
                self._tell(f"SIGINT again: ended at once{where} (exit code {Interrupted.exit_code})")
                os._exit(Interrupted.exit_code)
            return
        self._reason = signal.Signals(number).name
        ending = self._instead or f"ending with a checkpoint, which takes up to {self._grace_seconds:g} s"
        if number == signal.SIGINT and not self._instead:
            ending += "; another Ctrl-C ends at once, without it"
        self._tell(f"{self._reason}: {ending}")
        timer = threading.Timer(self._grace_seconds, self._give_up)
        timer.daemon = True
        timer.start()

    def _give_up(self) -> None:
        where = "" if self._instead else " on the last checkpoint"
        self._tell(f"that took too long: ended{where} (exit code {Interrupted.exit_code})")
        os._exit(Interrupted.exit_code)
