"""A search on SLURM: generation after generation as arrays, and between two of them a short job that submits the next.

That job (`advance.sbatch`) reads the search's folder and nothing else: it records what came of the runs, as
`grid.trials.advance` does anywhere, and writes down which array is next. Killed, requeued or submitted twice, it finds
what is there and does the same again; nothing but the folder decides what that is.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from space_dist.errors import ConfigError, Interrupted, SpaceDistError
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import run_statuses
from space_dist.grid.conductor import freeze, owning
from space_dist.grid.trials import advance, open_runs
from space_dist.slurm.arrays import Array, arrays_of
from space_dist.slurm.export import same_search
from space_dist.system.files import atomic_write, in_words

FIRST: Final = "first"  # in place of how far an array's runs were, where none was submitted before
_LOCK_SECONDS = 300.0  # for whoever works on the search now: longer than a dead node's claim is believed
_SEEN_SECONDS = 60.0  # in which a network file system may show what was there before
_LOOK_SECONDS = 2.0
_REACHED = re.compile(r"([0-9a-f]{16})-(\d{1,9})-(\d{1,18})")


@dataclass(frozen=True)
class NextArrays:
    """What is to be submitted for a search's open runs.

    trials: the digest of the trials that they are of. reached: how far they are, to be told when they have ended.
    arrays: of those tasks that have something to do. runs, waiting: how many are open, and how many of them not over.
    """

    trials: str
    reached: str
    arrays: tuple[Array, ...]
    runs: int
    waiting: int

    def write(self, path: Path) -> None:
        """For the script that submits them: a line of trials and reached, then one of each array."""
        lines = [f"{self.trials} {self.reached}", *(f"{array.first} {array.indices}" for array in self.arrays)]
        try:
            atomic_write(path, "".join(f"{line}\n" for line in lines).encode())
        except OSError as error:
            raise SpaceDistError(f"cannot write {path}: {in_words(error)}") from None


def digest_of_trials(manifest: Manifest) -> str:
    """`(16 hex digits)` what a task's number refers to: all trials of a search, and how each stands."""
    trials = [trial.to_json() for trial in manifest.searched.trials]
    return hashlib.sha256(json.dumps(trials, sort_keys=True).encode()).hexdigest()[:16]


def has_begun(manifest: Manifest) -> bool:
    """Whether the outcome of a run of the search is recorded already."""
    return any(
        trial.generation or trial.values or (trial.cell and trial.state != "open") for trial in manifest.searched.trials
    )


def settled_in(source: Grid, root: Path | None) -> Grid:
    """The search of an exported folder, there or below `root`, where it is put once and then grows.

    Raises ConfigError if what is there is another one, LedgerError if either is damaged.
    """
    manifest = source.manifest()
    if manifest.search is None:
        raise ConfigError(f"{source.folder} holds a grid, and no search: space-dist grid run {source.folder}")
    if root is None:
        return source
    grid = Grid(root / manifest.name)
    if not grid.manifest_file.exists():
        freeze(grid, manifest, source.instance_files(manifest))
    elif not same_search(grid.manifest(), manifest):
        raise ConfigError(
            f"{grid.folder} holds another search than {source.folder}, or the same one with other settings: export it "
            "again, with another --root or another name"
        )
    return grid


def gone_on(grid: Grid, after: str, say: Callable[[str], None]) -> Manifest:
    """Record what came of a search's open runs, as far as that can be done; returns the manifest then.

    after: `NextArrays.reached` of the array that has ended, or FIRST. Raises Interrupted if a user asked to stop or
    somebody else works on the search, HeldUpError and all else that `advance` does, and SpaceDistError if that array
    ended and none of its runs has got further: to submit it again would lead to the same, for ever.
    """
    if after != FIRST and not _REACHED.fullmatch(after):
        raise ConfigError(f"--after {after!r}: write {FIRST}, or what the array before was submitted with")
    give_up = time.monotonic() + _LOCK_SECONDS

    def stop_requested() -> str | None:
        return "somebody else works on this search" if time.monotonic() > give_up else None

    with owning(grid, wait=True, stop_requested=stop_requested, say=say):
        if grid.stop_file.exists():
            raise Interrupted("stopped by its user; ./submit.sh goes on")
        look_until = time.monotonic() + _SEEN_SECONDS
        while True:
            manifest = _advanced(grid)
            if manifest.searched.over or _further(after, reached(grid, manifest)):
                return manifest
            if time.monotonic() > look_until:
                break
            time.sleep(_LOOK_SECONDS)
    raise SpaceDistError(
        f"{grid.folder}: the array ended, and none of its runs has got further, so it is not submitted again: "
        f"`space-dist tune status {grid.folder}` and the jobs' output say why; ./submit.sh tries again"
    )


def _advanced(grid: Grid) -> Manifest:
    manifest = grid.manifest()
    while not manifest.searched.over:
        after = advance(grid, manifest)
        if after is None:
            break
        manifest = after
    return manifest


def _waiting(grid: Grid, manifest: Manifest) -> tuple[list[bool], int]:
    """Of every open run whether it is not over, and the steps of them all."""
    found = run_statuses(grid, manifest, manifest.code, open_runs(manifest))
    return [one.condition in ("waiting", "running") for one in found], sum(one.steps for one in found)


def reached(grid: Grid, manifest: Manifest) -> str:
    """How far the open runs of a search are: `<trials>-<runs that are over>-<steps>`."""
    waiting, steps = _waiting(grid, manifest)
    return f"{digest_of_trials(manifest)}-{waiting.count(False)}-{steps}"


def _further(before: str, now: str) -> bool:
    then, here = _REACHED.fullmatch(before), _REACHED.fullmatch(now)
    if then is None or here is None or then[1] != here[1]:
        return True
    return int(here[2]) > int(then[2]) or int(here[3]) > int(then[3])


def next_arrays(grid: Grid, manifest: Manifest, per_task: int, size: int, throttle: int | None) -> NextArrays:
    """The arrays of the open runs, `per_task` in each task; tasks all of whose runs are over are left out."""
    waiting, _ = _waiting(grid, manifest)
    tasks = sorted({number // per_task for number, waits in enumerate(waiting) if waits})
    return NextArrays(
        digest_of_trials(manifest), reached(grid, manifest), tuple(arrays_of(tasks, size, throttle)),
        len(waiting), waiting.count(True),
    )  # fmt: skip


def runs_of_task(grid: Grid, trials: str) -> tuple[Manifest, list[Run]] | None:
    """The open runs of the search that a task was submitted for; None: the search has gone on since.

    trials: the digest of its trials then. Raises LedgerError if the folder is damaged.
    """
    look_until = time.monotonic() + _SEEN_SECONDS
    while True:
        manifest = grid.manifest()
        if digest_of_trials(manifest) == trials:
            return manifest, open_runs(manifest)
        if time.monotonic() > look_until:
            return None
        time.sleep(_LOOK_SECONDS)
