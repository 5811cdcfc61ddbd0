"""The process that keeps MLflow's mirror of a run or of a grid, as whoever started it sees it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from typing import Final

_KILL_SECONDS: Final = 5.0


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
