"""What a run of a grid has said: its log, and what it printed beside that."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from space_dist.cli.terminal import warn
from space_dist.experiment.status import Attempts
from space_dist.grid.supervisor import OUTPUT

if TYPE_CHECKING:
    from space_dist.ledger import Ledger


class RunLog:
    """Prints the log of a run, and behind it what its last attempt has printed elsewhere, each as far as it grows.

    What is printed has no times. So what was left by attempts before the last one is only named: behind a log that
    has gone on since, it would pass for how that one ended.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._log, self._output, self._attempts = ledger.log, ledger.folder / OUTPUT, Attempts(ledger)
        self._shown: dict[Path, int] = {}  # bytes

    def show(self) -> None:
        """Print what is new."""
        for path in (self._log,) if self._is_of_before() else (self._log, self._output):
            self._shown[path] = _print_from(path, self._shown.get(path, 0))

    def tell_left_out(self) -> None:
        """Say where that is which was not shown."""
        if self._output not in self._shown and self._is_of_before():
            warn(f"what an earlier attempt printed beside its log is in {self._output}")

    def _is_of_before(self) -> bool:
        """Whether nothing was printed since the last attempt began, and something before."""
        begun = self._attempts.begun_at()
        with contextlib.suppress(OSError):
            seen = self._output.stat()
            return len(begun) > 1 and seen.st_size > 0 and seen.st_mtime < begun[-1]
        return False


def _print_from(path: Path, offset: int) -> int:
    """Print what a growing file holds from `offset` on; returns its new end."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(offset)
        text = file.read()
        if text:
            print(text.decode(errors="replace"), end="", flush=True)
        return offset + len(text)
    return offset
