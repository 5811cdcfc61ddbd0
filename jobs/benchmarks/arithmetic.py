"""What one arithmetic for all CPUs costs: training with it, and with `arithmetic: native`."""

from __future__ import annotations

import statistics
from dataclasses import replace
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.contenders import Contender, specification
from benchmarks.throughput import process
from space_dist.arithmetic import CHOICE

MEMBERS = 16  # of a population
TRPO = "learner={kind: trpo, n_steps: 2048, gamma: 0.95, target_kl: 0.004}"
WORKS = {
    "stock": Contender("ours", update="stock"),
    "lean": Contender("ours", update="lean"),
    "population, PPO": Contender("ours", update="population", members=MEMBERS),
    "population, TRPO": Contender("ours", update="population", members=MEMBERS, overrides=(TRPO,)),
}
FIRST = {True: "", False: f"import os; os.environ[{CHOICE!r}] = 'native'; "}  # whether it is ours
console = Console()


def arithmetic(
    rounds: Annotated[int, typer.Option(min=1, help="Interleaved rounds.")] = 5,
    seconds: Annotated[float, typer.Option(min=0.1, help="CPU time of one measurement, warm-up apart.")] = 3.0,
) -> None:
    """Environment steps per CPU second, collecting and learning, with one arithmetic for all CPUs and with `native`."""
    rates: dict[tuple[str, bool], list[float]] = {(work, ours): [] for work in WORKS for ours in (True, False)}
    for _ in range(rounds):
        for (work, ours), found in rates.items():
            contender = WORKS[work]
            if not ours:
                contender = replace(contender, overrides=(*contender.overrides, "arithmetic=native"))
            wanted = specification("pointmass", contender, seconds, cpu=True)
            found.append(process(wanted, FIRST[ours] + contender.first)["rate"])
    table = Table("", "one arithmetic, steps/s", "native, steps/s", "ratio (least and most)")
    for work in WORKS:
        settled, native = rates[work, True], rates[work, False]
        ratios = [one / other for one, other in zip(settled, native, strict=True)]
        table.add_row(
            work, f"{statistics.median(settled):,.0f}", f"{statistics.median(native):,.0f}",
            f"{statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
        )  # fmt: skip
    console.print(table)
    console.print("PPO or TRPO, 64-64, PointMass, 2,048 steps an update; medians of the rounds' own ratios.")
