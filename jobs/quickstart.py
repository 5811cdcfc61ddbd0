"""The quickstart: SPaCE and round robin on PointMass, three seeds each, side by side, in about two minutes.

One private Ray serves all runs; as many runs train at a time as there are cores. Started again after an interruption,
it goes on where it stopped.
"""

# ruff: noqa: E402 - Ray reads the environment when it is imported
from __future__ import annotations

import logging
import os
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from space_dist.launch import private_ray

private_ray()  # before Ray is imported

import ray
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from space_dist.cli.runs import print_report
from space_dist.errors import LedgerError, SpaceDistError
from space_dist.ledger import CURRICULUM, Ledger
from space_dist.report import build_report
from space_dist.tracking import sync

ROOT = Path(__file__).resolve().parent.parent
CURRICULA = ("space", "round_robin")
SEEDS = (0, 1, 2)
STEPS = 102_400
# Short enough for a first look: smaller updates of fewer epochs (the paper's PPO2 has 4), and a set that grows by 16
# (the third row of the paper's Table 1), so that SPaCE can reach all 100 instances within the budget.
SETTINGS = {
    "budget.steps": STEPS,
    "learner.n_steps": 1024,
    "learner.n_epochs": 4,
    "rollout.slots": 2,
    "tracking.live": "false",
    "checkpoint.every_seconds": 15,
}
SPACE_SETTINGS = {"curriculum.kappa": 16}

console = Console()


@dataclass
class Run:
    """One run of the quickstart, in a process of its own."""

    curriculum: str
    seed: int
    ledger: Ledger
    task: TaskID
    process: subprocess.Popen[bytes] | None = None

    def start(self, address: str) -> None:
        """Start or resume it."""
        settings = {**SETTINGS, **(SPACE_SETTINGS if self.curriculum == "space" else {}), "resources.address": address}
        config = ROOT / f"configs/pointmass_{self.curriculum}.yaml"
        command = [sys.executable, "-m", "space_dist.cli", "train", str(config)]
        command += ["--seed", str(self.seed), "--workers", "1", "--out", str(self.ledger.folder), "--resume"]
        for key, value in settings.items():
            command += ["--set", f"{key}={value}"]
        self.ledger.folder.mkdir(parents=True, exist_ok=True)
        with (self.ledger.folder / "output.txt").open("ab") as output:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)

    def show(self, bar: Progress) -> None:
        """Bring the run's line of the display up to date."""
        try:
            iterations, metrics = self.ledger.rows(CURRICULUM), self.ledger.rows()
        except LedgerError:
            return  # a row is being written
        steps = iterations[-1]["steps"] if iterations else 0
        size = len(iterations[-1]["trained"]) if iterations else 0
        returns = [row["test"]["return"] for row in metrics if row["kind"] == "evaluation"]
        shown = f"{returns[-1]:5.1f}" if returns else "    —"
        bar.update(self.task, completed=steps, line=f"{steps:>7,} steps  set {size:>3}/100  test return {shown}")


def train_all(runs: list[Run], bar: Progress, address: str) -> list[Run]:
    """Train them, as many at a time as there are cores; returns the ones that failed."""
    waiting, running, failed = list(runs), list[Run](), list[Run]()
    slots = max(1, len(os.sched_getaffinity(0)))
    while waiting or running:
        while waiting and len(running) < slots:
            running.append(waiting.pop(0))
            running[-1].start(address)
        time.sleep(0.5)
        for run in list(running):
            run.show(bar)
            if run.process is not None and run.process.poll() is not None:
                running.remove(run)
                if run.process.returncode != 0:
                    failed.append(run)
    return failed


def main() -> int:
    """Train, report, mirror to MLflow, and say what came out."""
    folder = Path("runs/quickstart")
    console.print(f"SPaCE and round robin on PointMass: {len(SEEDS)} seeds each, {STEPS:,} environment steps a run")
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[line]}"))
    with Progress(*columns, TimeElapsedColumn(), console=console) as bar:

        def add(curriculum: str, seed: int) -> TaskID:
            return bar.add_task(f"{curriculum:<11} seed {seed}", total=STEPS, line="")

        runs = [
            Run(curriculum, seed, Ledger(folder / curriculum / f"s{seed}"), add(curriculum, seed))
            for seed in SEEDS
            for curriculum in CURRICULA
        ]
        ray.init(
            address="local", num_cpus=2 * len(runs), include_dashboard=False, log_to_driver=False,
            logging_level=logging.ERROR, configure_logging=False, object_store_memory=256 << 20,
        )  # fmt: skip
        try:
            failed = train_all(runs, bar, ray.get_runtime_context().gcs_address)
        finally:
            for run in runs:
                if run.process is not None and run.process.poll() is None:
                    run.process.send_signal(signal.SIGTERM)
                    run.process.wait()
            ray.shutdown()
    if failed:
        for run in failed:
            log = run.ledger.folder / "output.txt"
            console.print(f"{run.curriculum}, seed {run.seed} failed: see {log}", style="red")
        console.print("`make quickstart` tries again and goes on where the others stopped.")
        return 1
    ledgers = [run.ledger for run in runs]
    print_report(build_report(ledgers, folder / "report"), console)
    sync(ledgers, uri=f"sqlite:///{Path('mlflow.db').absolute()}", experiment="quickstart")
    reached = [run for run in runs if run.curriculum == "space" and _reached_all(run.ledger)]
    console.print(
        f"SPaCE's set reached all 100 instances in {len(reached)} of {len(SEEDS)} runs"
        + ("" if len(reached) == len(SEEDS) else ": the value of the start settles too slowly for this short budget")
    )
    console.print(f"Figure:  {folder / 'report' / 'report.png'}", soft_wrap=True)
    console.print(f"MLflow:  make ui, then http://127.0.0.1:5000 (experiment 'quickstart', {len(runs)} runs)")
    console.print(f"Next:    space-dist train {shlex.quote('configs/pointmass_space.yaml')} --seed 0   (README.md)")
    return 0


def _reached_all(ledger: Ledger) -> bool:
    sizes = [row["curriculum"].get("size") for row in ledger.rows() if row["kind"] == "iteration"]
    return 100 in sizes


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SpaceDistError as error:
        console.print(f"quickstart: {error}", style="red", markup=False)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        console.print("Stopped. `make quickstart` goes on where it stopped.")
        sys.exit(75)
