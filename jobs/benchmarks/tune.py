"""What a search takes: ours, and Optuna over stock Stable-Baselines3 on the same trials, interleaved, by wall time."""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from subprocess import PIPE
from typing import Annotated, Any, Optional

import typer
from rich.console import Console

from benchmarks import throughput
from benchmarks.contenders import Contender, specification
from benchmarks.optuna_study import Asked
from benchmarks.processes import completed
from benchmarks.results import JsonFile, keep
from space_dist import config as configs
from space_dist.arithmetic import CHOICE
from space_dist.errors import SpaceDistError
from space_dist.experiment.manifest import Grid
from space_dist.system.provenance import git_state
from space_dist.system.workplace import cores

ROOT = Path(__file__).resolve().parents[2]
SEARCH = ROOT / "configs/tune/pointmass.yaml"
ARM, NAME = "round_robin", "benchmark"
UPDATE = 2048  # environment steps
TRYING = 5.0  # seconds a setting of stock SB3's is tried for
console = Console()


@dataclass(frozen=True)
class Taken:
    """One search, from its process's start to its end.

    seconds: wall time.  steps, evaluation_steps: of the environment, of all runs.  values: what each trial reached.
    shares: of the wall time on all cores, by what it went into.
    """

    seconds: float
    steps: int
    evaluation_steps: int
    values: tuple[float, ...]
    shares: Mapping[str, float]


@dataclass
class Row:
    """One line of the table, measured once a round."""

    title: str
    taken: list[Taken] = field(default_factory=list)

    @property
    def seconds(self) -> list[float]:
        """By round."""
        return [one.seconds for one in self.taken]

    @property
    def limit(self) -> str:
        """Where its time went, the most first: medians of the rounds."""
        shares = {what: statistics.median(one.shares[what] for one in self.taken) for what in self.taken[0].shares}
        ordered = sorted(shares.items(), key=lambda share: -share[1])
        return ", ".join(f"{what} {share:.0%}" for what, share in ordered)


def tune(
    trials: Annotated[int, typer.Option(min=1, help="Settings that are tried.")] = 8,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Of each trial.")] = 3,
    steps: Annotated[int, typer.Option(min=UPDATE, help="Environment steps of each run.")] = 20_480,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds, in each of which everybody searches once.")] = 3,
    generation: Annotated[int, typer.Option(min=1, help="Trials that our search asks at once.")] = 4,
    n_envs: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Environments of stock SB3; the fastest of 16 and 64 is found first, if not given."),
    ] = None,
    one_seed: Annotated[bool, typer.Option(help="Also with Optuna and one seed a trial, as most searches are.")] = True,
    json_file: JsonFile = None,
) -> None:
    """Wall time of a search: `space-dist tune run`, and Optuna over stock SB3 on the same trials."""
    if n_envs is not None and UPDATE % n_envs:
        raise typer.BadParameter(f"{UPDATE} steps an update are no multiple of {n_envs}", param_hint="--n-envs")
    chosen = n_envs or _fastest_stock()
    with tempfile.TemporaryDirectory() as name:  # compiles, where that was never done
        _ours(Path(name), _search(1, 1, UPDATE, 1))
    kernel = throughput.process(specification("pointmass", None, 0.0), Contender("ours").first)["kernel"]
    stock = f"Optuna, SB3 with our batched environment({chosen})"
    rows = {"ours": Row("`space-dist tune run`"), "optuna": Row(stock)}
    if one_seed and seeds > 1:
        rows["one_seed"] = Row(f"{stock}, one seed a trial")
    for number in range(rounds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for who, row in rows.items():
                row.taken.append(
                    _ours(folder, _search(trials, seeds, steps, generation), kernel) if who == "ours" else
                    _optuna(folder / "runs" / NAME, 1 if who == "one_seed" else seeds, chosen)
                )  # fmt: skip
                told = f"round {number + 1}: {row.title}: {row.seconds[-1]:.1f} s"
                console.print(told, markup=False, highlight=False, soft_wrap=True)
    _refuse_other_work(rows)
    console.print(_markdown(rows, trials, seeds), markup=False, highlight=False, soft_wrap=True)
    keep({name: [asdict(one) for one in row.taken] for name, row in rows.items()}, json_file)


def _fastest_stock() -> int:
    """Environments of stock SB3 with our batched environment, as `throughput` chooses them for its grids."""
    tried = [Contender("sb3", vec_env="batched", n_envs=n) for n in throughput.BATCHED]
    way_out = f"or say which of {' and '.join(str(n) for n in throughput.BATCHED)} it is with --n-envs"
    return throughput.fastest("pointmass", tried, TRYING, way_out).n_envs


def _search(trials: int, seeds: int, steps: int, generation: int) -> dict[str, Any]:
    """The shipped search in small: one arm."""
    data, folder = configs.read_yaml(SEARCH), SEARCH.parent
    sets = data["set"] | {"budget.steps": steps, "instances.test": str(folder / data["set"]["instances.test"])}
    final = {"test": str(folder / data["confirm"]["instances"]["test"])}
    return data | {
        "name": NAME, "extends": str(folder / data["extends"]), "set": sets, "arms": {ARM: data["arms"][ARM]},
        "trials": trials, "seeds": {"start": 0, "count": seeds}, "generation": generation, "tracking": {"uri": None},
        "confirm": data["confirm"] | {"instances": final},
    }  # fmt: skip


def _ours(folder: Path, search: Mapping[str, Any], kernel: float = 0.0) -> Taken:
    """`space-dist tune run` in an empty folder. kernel: seconds a step of the compiled update alone."""
    file = folder / "search.yaml"
    file.write_text(configs.to_yaml(dict(search)))
    words = [sys.executable, "-P", "-m", "space_dist.cli", "tune", "run", str(file), "--root", str(folder / "runs")]
    start = time.perf_counter()
    done = completed(words, stdout=PIPE, stderr=PIPE, cwd=folder, env=_environment())
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SpaceDistError(f"the search did not complete: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    grid = Grid(folder / "runs" / NAME)
    manifest = grid.manifest()
    values = [trial.value for trial in manifest.searched.trials]
    ledgers = [grid.ledger(run) for run in manifest.runs()]
    statuses = [ledger.status() for ledger in ledgers]
    if None in values or {status.state for status in statuses} != {"done"}:
        raise SpaceDistError("not all trials of the search are complete")
    steps = sum(status.steps for status in statuses)
    evaluated = [row for ledger in ledgers for row in ledger.rows() if row["kind"] == "evaluation"]
    running = _covered((status.started_at, status.updated_at) for status in statuses) / seconds
    update = kernel * steps / (cores() * seconds)
    return Taken(
        seconds, steps, sum(_evaluation_steps(row) for row in evaluated),
        tuple(value for value in values if value is not None),
        {"updating (the kernel alone)": update, "collecting, evaluating, ledgers": running - update,
         "starting, asking": 1.0 - running},
    )  # fmt: skip


def _environment() -> dict[str, str]:
    """Of both: modules are compiled once, as those of an installation are, whatever this process was told."""
    found = throughput.environment_of("")
    found.pop("PYTHONDONTWRITEBYTECODE", None)
    return found


def _evaluation_steps(row: Mapping[str, Any]) -> int:
    """Of the environment, of one evaluation of a run with one episode an instance."""
    return sum(round(row[split]["length"] * len(row[split]["returns"])) for split in ("train", "test"))


def _covered(spans: Iterable[tuple[float, float]]) -> float:
    """The length of the union of spans of time."""
    length, reached = 0.0, float("-inf")
    for begin, end in sorted(spans):
        length += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return length


def _optuna(folder: Path, seeds: int, n_envs: int) -> Taken:
    """The search in this folder once more, with so many of its seeds, as a study of stock SB3."""
    grid = Grid(folder)
    manifest = grid.manifest()
    schedules = {tuple(row["steps"] for row in grid.ledger(run).rows() if row["kind"] == "evaluation")
                 for run in manifest.runs()}  # fmt: skip
    if len(schedules) != 1:
        raise SpaceDistError("runs of the search were not evaluated after the same numbers of steps")
    asked = Asked(str(folder), seeds, schedules.pop(), n_envs, cores())
    # The libraries' own choice of kernels, as a script has it that knows nothing of ours.
    environment = {**_environment(), CHOICE: "native", "OPENBLAS_NUM_THREADS": "1", "NUMEXPR_NUM_THREADS": "1"}
    code = "from benchmarks.optuna_study import main; main()"
    words = [sys.executable, "-P", "-W", "ignore", "-c", code, json.dumps(asdict(asked))]
    start = time.perf_counter()
    done = completed(words, stdout=PIPE, stderr=PIPE, env=environment)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SpaceDistError(f"the study did not complete: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    found = json.loads(done.stdout.splitlines()[-1])
    runs = found["runs"]
    if len(runs) != len(manifest.searched.trials) * seeds:
        raise SpaceDistError(f"the study trained {len(runs)} runs")
    shares = {what: sum(run[what] for run in runs) / (asked.processes * seconds)
              for what in ("collecting", "learning", "evaluating")}  # fmt: skip
    shares["starting, waiting"] = 1.0 - sum(shares.values())
    steps, evaluation_steps = (sum(run[what] for run in runs) for what in ("steps", "evaluation_steps"))
    return Taken(seconds, steps, evaluation_steps, tuple(found["values"]), shares)


def _refuse_other_work(rows: Mapping[str, Row]) -> None:
    """Raise SpaceDistError if ours and Optuna's have not taken equally many training steps, in every round."""
    steps = {one.steps for name in ("ours", "optuna") for one in rows[name].taken}
    if len(steps) != 1:
        raise SpaceDistError(f"searches of {' and '.join(f'{one:,}' for one in sorted(steps))} steps are no comparison")


# ---- what is shown ----


def _markdown(rows: Mapping[str, Row], trials: int, seeds: int) -> str:
    ours = rows["ours"]
    libraries = ", ".join(f"{name} {version(name)}" for name in ("optuna", "stable-baselines3", "torch"))
    lines = [
        f"{trials} trials of {seeds} seeds on {cores()} cores, whole wall time from a process's start to its end: "
        f"medians of {len(ours.taken)} interleaved rounds (least and most), ratios of the rounds' own. Optuna's study "
        "tries the settings that ours has drawn, with the same seeds, instances, evaluations and network. "
        f"{libraries}; space_dist {git_state().get('git_commit', 'of no commit')[:12]}.",
        "",
        "| | wall time | ratio to ours | training steps | evaluation steps | training steps/s | mean of the trials "
        "| where the time goes |",
        "|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in rows.values():
        last = row.taken[-1]
        rates = [one.steps / one.seconds for one in row.taken]
        lines.append(
            f"| {row.title} | {_spread(row.seconds, '.1f')} s | {_spread(_ratios(row, ours), '.2f')} "
            f"| {last.steps:,} | {last.evaluation_steps:,} | {_spread(rates, ',.0f')} "
            f"| {statistics.mean(last.values):.1f} | {row.limit} |"
        )
    if "one_seed" in rows:
        ratios = _ratios(ours, rows["one_seed"])
        lines += ["", f"{seeds} seeds a trial cost {_spread(ratios, '.2f')} times here what one seed a trial costs "
                      "with Optuna over stock SB3."]  # fmt: skip
    return "\n".join(lines) + "\n"


def _ratios(row: Row, other: Row) -> list[float]:
    """Round by round: what slows the whole machine for a while slows both."""
    return [one / two for one, two in zip(row.seconds, other.seconds, strict=True)]


def _spread(numbers: Sequence[float], form: str) -> str:
    """The median, and the least and the most."""
    return f"{statistics.median(numbers):{form}} ({min(numbers):{form}}-{max(numbers):{form}})"
