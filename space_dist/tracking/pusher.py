"""The process that keeps the mirrors of a run or of a grid, as whoever started it sees it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

from space_dist.config import Mirrors
from space_dist.system.files import appending
from space_dist.system.importing import PYTHON

_KILL_SECONDS: Final = 5.0
_SOON_SECONDS: Final = 2.0
_LOOK_SECONDS: Final = 0.05
NO_LONGER: Final = "no longer waiting for the mirror, which goes on by itself; all else is done"
_MOST_SAID: Final = 1 << 20  # bytes of what it says that are looked through
_REFUSED: Final = 2  # its exit code where somebody has to mend something first, which it says last
_BEGINNING: Final = "space-dist: "  # of sentences on standard error
LOOK_AT: Final = "Look at "  # begins the lines in which `sync` names MLflow's pages


class Pusher:
    """One process that pushes all there is in a folder: a store has one writer, and a slow server costs no training.

    tracking: where to, for messages (`where`).  folder: a run's or a grid's.  log_file: where it writes what it says.
    Raises OSError if that cannot be written or no process can be started.
    """

    def __init__(self, tracking: Mirrors, folder: Path, log_file: Path) -> None:
        places = [f"MLflow at {tracking.uri}"] if tracking.uri is not None else []
        self.where, self._folder, self._log_file = " and ".join([*places, *tracking.sinks]), folder, log_file
        command = [*PYTHON, "-m", "space_dist.cli", "sync", "--follow", "--", str(folder)]
        with appending(log_file) as output:
            self._said_before = os.fstat(output.fileno()).st_size
            # A session of its own: Ctrl-C is for the work; the pusher ends by itself once whoever works has let go.
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )  # fmt: skip

    def is_soon_over(self) -> bool:
        """Whether it ends before anybody asks what is being waited for."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=_SOON_SECONDS)
        return self._process.returncode is not None

    def warning(
        self, seconds: float, what: Literal["run", "grid"], leave: Callable[[], bool] = lambda: False
    ) -> str | None:
        """None once it has ended well; after `seconds` it is ended, and this says what the mirror may lack.

        leave: whether to wait no longer, for it goes on by itself.
        """
        until = time.monotonic() + seconds
        while self._process.poll() is None and time.monotonic() < until:
            if leave():
                return (
                    f"{self.where} is still being brought up to date, by process {self._process.pid}; should that be "
                    f"ended, too, `space-dist sync {self._folder}` does it (details: {self._log_file})"
                )
            time.sleep(_LOOK_SECONDS)
        if ended_within(self._process, 0.0):
            return None
        # Negative: it was still at it, has said nothing maybe, and was ended.
        why = f" in {seconds:.0f} s" if self._process.returncode < 0 else ""
        if self._process.returncode == _REFUSED and (said := self._said()):
            why = f": {said[-1].removeprefix(_BEGINNING)}"
        could = f"not all of {self.where} could" if " and " in self.where else f"{self.where} could not"
        return (
            f"{could} be brought up to date{why}; nothing is lost: `space-dist sync {self._folder}` "
            f"replays the {what}, and with `--uri URI` elsewhere than into the store that it was begun with "
            f"(details: {self._log_file})"
        )

    def pages(self) -> list[str]:
        """Where to look at what was pushed, in words; none before it has ended well."""
        # Each once: the pusher of a conductor that was killed writes its own into the same file.
        return list(dict.fromkeys(line.removeprefix(LOOK_AT) for line in self._said() if line.startswith(LOOK_AT)))

    def _said(self) -> list[str]:
        """The lines that it has said."""
        with contextlib.suppress(OSError), self._log_file.open("rb") as log:
            log.seek(self._said_before)
            return log.read(_MOST_SAID).decode(errors="replace").splitlines()
        return []


def ended_within(pusher: subprocess.Popen[bytes], seconds: float) -> bool:
    """Whether a pusher ends well in time; it, and whatever it started, is ended otherwise."""
    try:
        return pusher.wait(timeout=seconds) == 0
    except subprocess.TimeoutExpired:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(pusher.pid, number)  # it leads a session
            with contextlib.suppress(subprocess.TimeoutExpired):
                pusher.wait(timeout=_KILL_SECONDS)
                break
        return False
