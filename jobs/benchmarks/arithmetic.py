"""What one arithmetic for all CPUs costs: training with its settings, and with what libraries choose by themselves."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from space_dist.arithmetic import SETTINGS
from space_dist.errors import SpaceDistError

ROOT = Path(__file__).resolve().parents[2]
MEMBERS = 16  # of the population
STEPS = {"stock": 12_288, "lean": 24_576, "population": 12_288}  # environment steps of a run, and of each member
TRPO = "learner={kind: trpo, n_steps: 2048, gamma: 0.95, target_kl: 0.004}"
WORKS = {
    "stock": ["learner.update=stock"],
    "lean": ["learner.update=lean"],
    "population, PPO": ["engine=population"],
    "population, TRPO": ["engine=population", TRPO],
}
# Libraries read the environment once, when they are loaded or first used: what comes later changes nothing.
NATIVE = "import numpy, scipy.linalg, torch; torch.ones(64, 64) @ torch.ones(64, 64); torch.ones(64).exp(); "
CHILD = "from benchmarks.arithmetic import child; import sys; child(*sys.argv[1:])"
console = Console()


def arithmetic(
    rounds: Annotated[int, typer.Option(min=1, help="Interleaved rounds.")] = 5,
) -> None:
    """Environment steps per CPU second, collecting and learning, with one arithmetic for all CPUs and without."""
    rates: dict[tuple[str, bool], list[float]] = {(work, ours): [] for work in WORKS for ours in (True, False)}
    for _ in range(rounds):
        for (work, ours), found in rates.items():
            found.append(_measured(work, ours))
    table = Table("", "one arithmetic, steps/s", "libraries' own choice, steps/s", "ratio (least and most)")
    for work in WORKS:
        settled, native = rates[work, True], rates[work, False]
        ratios = [one / other for one, other in zip(settled, native, strict=True)]
        table.add_row(
            work, f"{statistics.median(settled):,.0f}", f"{statistics.median(native):,.0f}",
            f"{statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
        )  # fmt: skip
    console.print(table)
    console.print("PPO or TRPO, 64-64, PointMass, 2,048 steps an update; medians of the rounds' own ratios.")


def _measured(work: str, ours: bool) -> float:
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    code = CHILD if ours else NATIVE + CHILD
    environment["PYTHONPATH"] = str(ROOT / "jobs")
    with TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code, work, folder],
            env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
    if done.returncode:
        raise SpaceDistError(f"{work} failed: {done.stderr.strip().splitlines()[-1]}")
    return float(done.stdout.split()[-1])


def child(work: str, folder: str) -> None:
    """Train `work` in this process and print environment steps per CPU second, evaluation and start-up apart."""
    from space_dist import config as configs
    from space_dist.interrupts import StopRequests
    from space_dist.learner import preload
    from space_dist.population import advance, member

    several = work.startswith("population")
    budget = STEPS["population" if several else work]
    settings = [
        *WORKS[work], f"budget.steps={budget}", "evaluation.every_steps=1000000000", "tracking.uri=null",
        "resources.workers=0", "checkpoint.every_rounds=1000000", "checkpoint.every_seconds=100000",
    ]  # fmt: skip
    runs = {
        Path(folder) / str(seed): configs.load(ROOT / "configs/pointmass_space.yaml", [*settings, f"seed={seed}"])
        for seed in range(MEMBERS if several else 1)
    }
    preload()
    stop = StopRequests()
    if several:
        works = {path: member(config, path, stop=stop) for path, config in runs.items()}
        start = time.process_time()
        advance(works, lambda path, outcome: None)
    else:
        from space_dist.launch import launch

        start = time.process_time()
        for path, config in runs.items():
            launch(config, path, resume=False, stop=stop)
    sys.stdout.write(f"{len(runs) * budget / (time.process_time() - start)}\n")
