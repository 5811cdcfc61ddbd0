"""Who forks supervisors, apart from all that uses it: the sooner it starts to import, the sooner runs begin."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Final

from space_dist.system.files import appending
from space_dist.system.importing import PYTHON

SAID: Final = "pool.log"  # by supervisors, in a grid's folder


class ForkServer:
    """`python -m space_dist.grid.supervisor`, whose forks are supervisors: however many, they are imported for once.

    Started by whoever asks first, and anew when it is lost, which costs no supervisor anything. As a context: it is
    started, and ends with it.
    """

    def __init__(self) -> None:
        self._running: tuple[subprocess.Popen[bytes], socket.socket] | None = None  # and where it is asked

    def __enter__(self) -> ForkServer:
        with contextlib.suppress(OSError):  # told by whoever cannot do without
            self._started(None)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def forked(self, folder: Path) -> tuple[socket.socket, subprocess.Popen[bytes]]:
        """Our end of a new supervisor's socket, and the process that forks it. folder: of the grid it is for.

        The socket is at its end once supervisor and server have closed theirs; the server's last word there is the
        supervisor's exit code. Raises OSError if no process can be started.
        """
        process, requests = self._started(folder)
        ours, its = socket.socketpair()
        # Where it has ended a moment ago, the socket is at its end.
        with its, contextlib.suppress(ConnectionError):
            socket.send_fds(requests, [b"+"], [its.fileno()])
        return ours, process

    def close(self) -> None:
        """End it at once: its forks end by themselves."""
        if self._running is not None:
            process, requests = self._running
            process.kill()
            process.wait()
            requests.close()
            self._running = None

    def _started(self, folder: Path | None) -> tuple[subprocess.Popen[bytes], socket.socket]:
        """One that lives. What a new one says before it has a fork goes into this grid's folder; None: nowhere."""
        if self._running is not None and self._running[0].poll() is None:
            return self._running
        self.close()
        command = [*PYTHON, "-m", "space_dist.grid.supervisor"]
        # Nothing of a Ray actor's own identity: runs that join Ray join it as drivers.
        environment = {key: value for key, value in os.environ.items() if not key.startswith("RAY_JOB_")}
        requests, its = socket.socketpair()
        with its, Path(os.devnull).open("ab") if folder is None else appending(folder / SAID) as errors:
            try:
                process = subprocess.Popen(command, stdin=its.fileno(), stdout=errors, stderr=errors, env=environment)
            except OSError:
                requests.close()
                raise
        self._running = process, requests
        return self._running
