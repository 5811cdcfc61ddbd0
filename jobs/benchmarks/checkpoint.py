"""What checkpoints cost: the same run with them at the default interval, and with none but its last."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.results import JsonFile, keep, refuse_if
from space_dist import config as configs
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests

ROOT = Path(__file__).resolve().parents[2]
console = Console()

LIMIT = 0.02  # of a run's wall time
NEVER = ["checkpoint.every_rounds=1000000000", "checkpoint.every_seconds=1000000000"]
# Steps enough to fill the replay buffer of 100,000 transitions and to go on with it full.
RUNS = {
    "PPO": ("pointmass_space", ["budget.steps=81920"]),
    "DQN, 100,000 transitions": (
        "cartpole_dqn_space",
        ["budget.steps=130000", "budget.episodes=null", "learner.buffer_size=100000",
         "learner.gradient_steps_per_step=0.25"],  # SB3's default
    ),
}  # fmt: skip


def checkpoint(
    repeats: Annotated[int, typer.Option(min=1, help="Pairs of runs of each kind.")] = 1,
    json_file: JsonFile = None,
) -> None:
    """What checkpoints cost at the default interval, as a share of a run's wall time; a full replay buffer included."""
    table = Table(title="Checkpointing at the default interval")
    columns = ("run", "with", "without", "commits", "in commits", "share", "at most")
    for column in columns:
        table.add_column(column, justify="right")
    rows, exceeded = [], False
    for name, (config, settings) in RUNS.items():
        pairs = [(_seconds(config, settings), _seconds(config, [*settings, *NEVER])) for _ in range(repeats)]
        best = {side: min(pair[side] for pair in pairs) for side in (0, 1)}
        extra = [having[2] - none[2] for having, none in pairs]
        share = statistics.median(extra) / best[1][0]
        exceeded |= share > LIMIT
        row = {
            "run": name, "with": best[0][0], "without": best[1][0], "commits": pairs[0][0][1],
            "in_commits": statistics.median(extra), "share": share, "limit": LIMIT,
        }  # fmt: skip
        rows.append(row)
        table.add_row(
            name, f"{row['with']:.1f} s", f"{row['without']:.1f} s", str(row["commits"]),
            f"{row['in_commits']:.3f} s", f"{share:.2%}", f"{LIMIT:.0%}",
        )  # fmt: skip
    console.print(table)
    console.print(
        "The share is the time inside commits and pieces of the replay buffer, less that of the one commit of its twin "
        "that makes none on the way: the difference of two wall times would be noise."
    )
    keep(rows, json_file)
    refuse_if(exceeded, console)


def _seconds(name: str, settings: list[str]) -> tuple[float, int, float]:
    """Wall seconds of a run, its commits, and the wall seconds that they took, encoding included."""
    from space_dist.run.requests import Work
    from space_dist.run.training import Training

    spent: list[float] = []
    commit = Training._commit

    def timed(self: Training, state: str, message: str | None = None) -> Work[None]:
        yield from self._settle()  # work that a commit waits for is none of its cost
        start = time.perf_counter()
        yield from commit(self, state, message)
        spent.append(time.perf_counter() - start)

    config = configs.load(ROOT / f"configs/{name}.yaml", ["tracking.uri=null", "resources.workers=0", *settings])
    Training._commit = timed  # type: ignore[method-assign]
    try:
        with tempfile.TemporaryDirectory(dir=_disk()) as folder:
            start = time.perf_counter()
            launch(config, Path(folder) / "run", resume=True, stop=StopRequests())
            return time.perf_counter() - start, len(spent), sum(spent)
    finally:
        Training._commit = commit  # type: ignore[method-assign]


def _disk() -> Path:
    """A folder on a real disk, which /tmp may not be."""
    folder = ROOT / "runs"
    folder.mkdir(exist_ok=True)
    return folder
