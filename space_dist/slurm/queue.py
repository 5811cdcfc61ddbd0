"""What SLURM knows of a grid's jobs: one call of squeue; and one of sacct, where it works, of those that have ended."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from space_dist.config import clean
from space_dist.slurm.export import JOBS
from space_dist.system.files import read_file

_AGAIN_SECONDS = 30.0  # between two questions to SLURM: a controller serves everybody
_SECONDS = 20.0  # for squeue and sacct, whose controller may be busy or gone
_MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class Queue:
    """Jobs of a grid's last submission. Ids are SLURM's, by what each is (`train` may have several).

    answered: whether squeue did. live: `train PENDING (Resources)` -> tasks. ended: the same of sacct's, if it works.
    """

    jobs: Mapping[str, tuple[str, ...]]
    answered: bool
    live: Mapping[str, int] = field(default_factory=dict)
    ended: Mapping[str, int] = field(default_factory=dict)

    def in_words(self) -> str:
        """One line."""
        what = "; ".join(f"{kind} {', '.join(ids)}" for kind, ids in self.jobs.items())
        if not self.answered:
            return f"SLURM jobs: {what}; squeue does not answer here, so this is by the runs' own files"
        live = ", ".join(f"{count} {state}" for state, count in self.live.items()) or "none in the queue now"
        ended = ", ".join(f"{count} {state}" for state, count in self.ended.items())
        return f"SLURM jobs: {what}; {live}" + (f"; ended: {ended}" if ended else "")

    def to_json(self) -> dict[str, Any]:
        """For `--json`."""
        return {"jobs": {kind: list(ids) for kind, ids in self.jobs.items()}, "answered": self.answered,
                "live": dict(self.live), "ended": dict(self.ended)}  # fmt: skip


def queue_of(folder: Path) -> Queue | None:
    """Of the grid in `folder`; None if it was never submitted to SLURM."""
    jobs = _jobs(folder)
    if not jobs:
        return None
    kinds = {number: kind for kind, numbers in jobs.items() for number in numbers}
    ids = ",".join(kinds)
    # --array: one line for each task, where squeue would otherwise put pending ones together.
    said = _ask("squeue", "--noheader", "--array", f"--jobs={ids}", "--format=%F|%T|%r")
    live = _count(said or "", kinds)
    # --allocations: a job's steps (.batch, .extern) would be counted as jobs of their own.
    past = _ask("sacct", "--noheader", "--parsable2", "--allocations", f"--jobs={ids}", "--format=JobID,State,ExitCode")
    ended = {state: count for state, count in _count(past or "", kinds).items()
             if not any(word in state for word in ("pending", "running", "requeued"))}  # fmt: skip
    return Queue(jobs, said is not None, live, ended)


class WatchedQueue:
    """The same, for whoever looks again and again."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._asked = folder, time.monotonic()
        self._known = queue_of(folder)

    def now(self) -> Queue | None:
        """Half a minute old at most."""
        if time.monotonic() - self._asked >= _AGAIN_SECONDS:
            self._asked, self._known = time.monotonic(), queue_of(self._folder)
        return self._known


def _jobs(folder: Path) -> dict[str, tuple[str, ...]]:
    try:
        text = read_file(folder / JOBS, _MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError):
        return {}
    jobs: dict[str, tuple[str, ...]] = {}
    for line in text.splitlines():
        number, _, kind = line.partition(" ")
        if number.isdecimal() and number.isascii() and kind in ("train", "aggregate", "advance"):
            jobs[kind] = (*jobs.get(kind, ()), number)
    return jobs


def _count(text: str, kinds: Mapping[str, str]) -> dict[str, int]:
    """`<job>|<state>|<why>` lines, counted by what and state."""
    counts: Counter[str] = Counter()
    for line in text.splitlines():
        number, _, rest = line.partition("|")
        state, _, why = rest.partition("|")
        kind = kinds.get(number.partition("_")[0])
        if kind is not None:
            reason = f" ({clean(why)})" if why not in ("", "None", "0:0") else ""
            counts[f"{kind} {clean(state).lower()}{reason}"] += 1
    return dict(counts)


def _ask(program: str, *arguments: str) -> str | None:
    """What it prints; None if it is not there, or fails. Jobs that SLURM has forgotten are no failure."""
    path = shutil.which(program)
    if path is None:
        return None
    try:
        done = subprocess.run([path, *arguments], capture_output=True, text=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode and "Invalid job id" in done.stderr:
        return ""
    return None if done.returncode else done.stdout[:_MAX_BYTES]
