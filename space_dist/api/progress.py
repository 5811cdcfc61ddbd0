"""A line that says how far a run or a grid is, and changes in its place: in a notebook's cell, or on a terminal."""

from __future__ import annotations

import contextlib
import html
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final, Protocol

if TYPE_CHECKING:
    from space_dist.grid.conductor import Overview
    from space_dist.run.training import Progress

_SECONDS: Final = 0.25  # between two changes of the line


class _Place(Protocol):
    """Where a line is shown."""

    def show(self, line: str) -> None:
        """Show it instead of the one before."""

    def close(self) -> None:
        """Leave the last line there."""


class _Cell:
    """The output of a notebook's cell."""

    def __init__(self) -> None:
        from IPython.display import display  # it is there: this code runs in it

        self._handle: Any = display(_page(""), raw=True, display_id=True)

    def show(self, line: str) -> None:
        self._handle.update(_page(line), raw=True)

    def close(self) -> None:
        pass


class _Terminal:
    """The last line of a terminal."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live("", auto_refresh=False)
        self._live.start()

    def show(self, line: str) -> None:
        from rich.text import Text

        self._live.update(Text(line), refresh=True)

    def close(self) -> None:
        self._live.stop()


def _page(line: str) -> dict[str, str]:
    return {"text/plain": line, "text/html": f"<code>{html.escape(line)}</code>"}


def in_notebook() -> bool:
    """Whether this code runs in the cell of a notebook, or of whatever else shows IPython's rich output."""
    shell = sys.modules.get("IPython")
    found = shell.get_ipython() if shell is not None else None
    return found is not None and getattr(found, "kernel", None) is not None


def keep(line: str, *, wanted: bool) -> None:
    """Show a line that stays, whatever is shown later; beside a script's own output, if nobody watches that."""
    if wanted:
        # Above what a terminal's last line is: rich sees to that.
        print(line, flush=True, file=None if in_notebook() or _on_terminal() else sys.stderr)


def _on_terminal() -> bool:
    return sys.stdout is not None and sys.stdout.isatty()


@contextlib.contextmanager
def shown(wanted: bool) -> Iterator[Callable[[str], None]]:
    """A function that shows a line instead of the one before; one that shows nothing where nobody would look."""
    place: _Place | None = None
    if wanted and in_notebook():
        place = _Cell()
    elif wanted and _on_terminal():
        place = _Terminal()
    if place is None:
        yield lambda line: None
        return
    last, shown_at = "", 0.0
    here = place

    def show(line: str) -> None:
        nonlocal last, shown_at
        last = line
        if time.monotonic() - shown_at >= _SECONDS:
            here.show(line)
            shown_at = time.monotonic()

    try:
        yield show
        here.show(last)
    finally:
        here.close()


def line_of_run(name: str, seed: int, progress: Progress) -> str:
    """`pointmass_space s0  12,288/100,000 steps (12%)  5,012/s  set 4/100  return train 1.20 test 1.10 at 10,240`."""
    return (
        f"{name} s{seed}  {progress.so_far} ({progress.share:.0%})  "
        f"{progress.pace}  set {progress.trained}  return {progress.returns}"
    )


def line_of_grid(name: str, overview: Overview) -> str:
    """`quickstart  2 of 6 runs done, 2 running, 2 waiting, 0 failed`."""
    line = (
        f"{name}  {overview.done} of {overview.total} runs done, {len(overview.running)} running, "
        f"{overview.waiting} waiting, {overview.failed} failed"
    )
    return f"{line} (last: {overview.message})" if overview.message else line
