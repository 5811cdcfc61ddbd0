"""Whether the population learns what Stable-Baselines3 learns: a paired equivalence test on PointMass.

Both arms have the same seeds, and with a seed the first weights, contexts and noise: what is left to differ is the
update, and what becomes of its rounding. Fixed before any run of the two arms is looked at: the metric (mean
undiscounted return over the held-out instances after the last update), the margin (a share of the pilot's mean), both
error rates, and how the number of seeds follows from the spread between the pilot's: as if seeds were not paired, and
from the upper 90 % limit of its standard deviation (Browne 1995), since a pilot that happens to spread little would
promise too much. The pilot is a population, which costs a minute, and its seeds are used for nothing else.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import stats

from benchmarks.processes import completed
from benchmarks.results import JsonFile, can_be_a_folder, keep
from space_dist import config as configs
from space_dist.errors import SpaceDistError, nearest
from space_dist.experiment.manifest import Grid

ROOT = Path(__file__).resolve().parents[2]
MARGIN = 0.05  # share of the pilot's mean return
ALPHA = 0.05  # of each one-sided test
POWER = 0.9  # where there is no difference
PILOT = range(9000, 9024)
BATCH_SIZE = 512  # transitions: 40 gradient steps an update; with 320, SB3 takes hours of a core
CONFIDENCE = 0.9  # in the limit of the pilot's standard deviation
FIRST_SEED = 16000
FEWEST, MOST = 30, 200  # seeds per arm
console = Console()


@dataclass(frozen=True)
class Comparison:
    """The population against SB3. correlation: over seeds.  difference: of means, with its 90 % interval.

    p: of the two one-sided tests, the larger.
    """

    means: tuple[float, float]
    correlation: float
    difference: float
    low: float
    high: float
    p: float

    @property
    def equivalent(self) -> bool:
        """Whether a difference as large as the margin can be ruled out."""
        return self.p < ALPHA


def equivalence(
    curriculum: Annotated[str, typer.Option(help="Which config: configs/pointmass_CURRICULUM.yaml.")] = "round_robin",
    steps: Annotated[int, typer.Option(min=4096, help="Environment steps of each run.")] = 204_800,
    root: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Keep the runs here; what is done stays.", callback=can_be_a_folder),
    ] = None,
    max_parallel: Annotated[int, typer.Option(min=1, help="Processes at a time.")] = 2,
    json_file: JsonFile = None,
) -> None:
    """TOST: the population engine against SB3 on PointMass."""
    shipped = sorted(path.stem.removeprefix("pointmass_") for path in ROOT.glob("configs/pointmass_*.yaml"))
    if curriculum not in shipped:
        raise typer.BadParameter(
            f"there is no configs/pointmass_{curriculum}.yaml{nearest(curriculum, shipped)} Allowed: "
            f"{', '.join(shipped)}",
            param_hint="--curriculum",
        )
    with tempfile.TemporaryDirectory() as temporary:
        folder = root or Path(temporary)
        arms = _Arms(folder.absolute(), ROOT / f"configs/pointmass_{curriculum}.yaml", steps, max_parallel)
        pilot = arms.returns("pilot", "population", list(PILOT))
        margin, spread = MARGIN * float(pilot.mean()), float(pilot.std(ddof=1))
        seeds = needed(upper_limit(spread, len(pilot)), margin)
        console.print(
            f"pilot: population, {len(pilot)} seeds: mean {pilot.mean():.2f}, standard deviation {spread:.2f}, "
            f"at most {upper_limit(spread, len(pilot)):.2f} ({CONFIDENCE:.0%}); margin {margin:.2f} ({MARGIN:.0%}); "
            f"{POWER:.0%} power needs {seeds} seeds an arm", highlight=False,
        )  # fmt: skip
        count = min(max(seeds, FEWEST), MOST)
        both = list(range(FIRST_SEED, FIRST_SEED + count))
        sb3, population = arms.returns("sb3", "single", both), arms.returns("population", "population", both)
    found = compare(population, sb3, margin)
    table = Table(title=f"PointMass, {curriculum}, {steps:,} steps, the same {count} seeds; margin {margin:.2f}")
    for column in ("means, population / SB3", "correlation", "difference [90 % interval]", "p (TOST)", "equivalent"):
        table.add_column(column)
    table.add_row(
        " / ".join(f"{mean:.2f}" for mean in found.means), f"{found.correlation:.2f}",
        f"{found.difference:+.2f} [{found.low:+.2f}, {found.high:+.2f}]", f"{found.p:.2g}",
        "yes" if found.equivalent else "not shown",
    )  # fmt: skip
    console.print(table)
    if seeds > MOST:
        console.print(f"Only {MOST} of the {seeds} seeds were run: the power is lower.", style="red")
    numbers = {"margin": margin, "pilot_std": spread, "seeds": count, "seeds_needed": seeds,
               **asdict(found), "equivalent": found.equivalent}  # fmt: skip
    keep(numbers, json_file)
    if not found.equivalent:
        raise typer.Exit(1)


def upper_limit(spread: float, count: int) -> float:
    """Below which the standard deviation lies, with CONFIDENCE, of which `spread` is a sample of `count`."""
    return spread * math.sqrt((count - 1) / float(stats.chi2.ppf(1 - CONFIDENCE, count - 1)))


def needed(spread: float, margin: float) -> int:
    """Seeds per arm for POWER if there is no difference (Phillips 1990) and all arms have this standard deviation."""
    for count in range(2, 10_000):
        freedom = 2 * count - 2
        distance = margin / (spread * math.sqrt(2 / count))
        if 2 * float(stats.t.cdf(distance - stats.t.ppf(1 - ALPHA, freedom), freedom)) - 1 >= POWER:
            return count
    raise SpaceDistError("no number of seeds would show equivalence within this margin")


def compare(ours: NDArray[np.float64], theirs: NDArray[np.float64], margin: float) -> Comparison:
    """Two one-sided paired t-tests (Schuirmann 1987) on runs of the same seeds, `(seeds,)` each."""
    lower = stats.ttest_rel(ours + margin, theirs, alternative="greater")
    upper = stats.ttest_rel(ours - margin, theirs, alternative="less")
    interval = stats.ttest_rel(ours, theirs).confidence_interval(1 - 2 * ALPHA)
    return Comparison(
        (float(ours.mean()), float(theirs.mean())), float(np.corrcoef(ours, theirs)[0, 1]),
        float(ours.mean() - theirs.mean()), float(interval.low), float(interval.high),
        float(max(lower.pvalue, upper.pvalue)),
    )  # fmt: skip


@dataclass(frozen=True)
class _Arms:
    folder: Path
    config: Path
    steps: int
    max_parallel: int

    def returns(self, name: str, engine: str, seeds: Sequence[int]) -> NDArray[np.float64]:
        """(len(seeds),) the final held-out return of each run."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{name}.yaml"
        path.write_text(configs.to_yaml({
            "name": name, "extends": str(self.config), "seeds": list(seeds), "tracking": {"uri": None},
            "set": {"budget.steps": self.steps, "engine": engine, "learner.batch_size": BATCH_SIZE,
                    "evaluation.every_steps": self.steps},
        }))  # fmt: skip
        command = [sys.executable, "-m", "space_dist.cli", "grid", "run", str(path), "--root", str(self.folder),
                   "--max-parallel", str(self.max_parallel)]  # fmt: skip
        if completed(command, stdout=subprocess.DEVNULL).returncode:
            raise SpaceDistError(f"the arm {name} did not complete: {self.folder / name}")
        grid = Grid(self.folder / name)
        rows = [grid.ledger(run).rows() for run in grid.manifest().runs()]
        finals = [[row for row in one if row["kind"] == "evaluation"][-1] for one in rows]
        if {row["steps"] for row in finals} != {finals[0]["steps"]}:
            raise SpaceDistError(f"the runs of {name} ended after different numbers of steps")
        return np.array([row["test"]["return"] for row in finals])
