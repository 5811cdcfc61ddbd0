"""The command line: parse, build, call. Exit codes: 0 done, 75 stopped and resumable, 2 bad input, else failed."""

from __future__ import annotations

import os

# ruff: noqa: E402 - what follows must happen before anything heavy is imported
# One thread for all arithmetic, in every process of ours, before any library reads these.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from space_dist.interrupts import StopRequests

STOP = StopRequests()

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from space_dist.errors import ConfigError, SpaceDistError

if TYPE_CHECKING:
    from space_dist.report import Report
    from space_dist.training import Progress

app = typer.Typer(
    name="space-dist", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Self-paced curricula for contextual reinforcement learning.",
)  # fmt: skip
instances_app = typer.Typer(no_args_is_help=True, help="Make and check instance sets.")
config_app = typer.Typer(no_args_is_help=True, help="Explain and check configs.")
app.add_typer(instances_app, name="instances")
app.add_typer(config_app, name="config")

console = Console()
errors = Console(stderr=True)

_REPORT_WIDTH = 200  # characters

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders, or folders that hold some.")]
Overrides = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--set", metavar="KEY=VALUE", help="Override a config key, e.g. budget.steps=20000. Repeatable."),
]


@app.command()
def train(
    config: Annotated[Path, typer.Argument(help="A run's YAML file.")],
    overrides: Overrides = None,
    seed: Annotated[Optional[int], typer.Option(help="The run's seed.")] = None,  # noqa: UP045
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Ray rollout actors; 0: everything in this process. Decides no result."),
    ] = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="The run's folder. Default: runs/<name>/s<seed>."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run in the folder, if there is one.")] = False,
) -> None:
    """Train one policy under one curriculum."""
    STOP.install()
    from space_dist import config as configs
    from space_dist.launch import about, default_folder, launch

    settings = list(overrides or [])
    if workers is not None:
        settings.append(f"resources.workers={workers}")
    run = configs.load(config, settings, seed=seed)
    folder = out if out is not None else default_folder(run)
    with about(str(config)), _display(run.name, run.seed) as observe:
        outcome = launch(run, folder, resume=resume, stop=STOP, observe=observe)
    status = outcome.ledger.status()
    verb = "was already done" if outcome.already_done else "done"
    console.print(
        f"{run.name}, seed {run.seed}: {verb}, {status.steps:,} environment steps. {folder}",
        highlight=False, markup=False, soft_wrap=True,
    )  # fmt: skip
    if outcome.tracking_warning:
        errors.print(f"warning: {outcome.tracking_warning}", highlight=False, markup=False, soft_wrap=True)


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    instances: Annotated[Path, typer.Option(help="CSV of the instances to evaluate on.")],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Also write every instance's results to this CSV."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Evaluate a run's policy, deterministically, on any instances of its environment."""
    import numpy as np

    from space_dist import config as configs
    from space_dist.instances import read_csv
    from space_dist.launch import policy_of
    from space_dist.ledger import Ledger
    from space_dist.rollout import evaluate as evaluate_policy
    from space_dist.seeding import Purpose, episode_seeds
    from space_dist.training import make_env

    ledger = Ledger(run)
    status = ledger.status()
    config = configs.load(ledger.config)
    policy = policy_of(ledger)
    chosen = read_csv(instances, make_env(config).context_bounds)
    env = make_env(config, len(chosen))
    seeds = episode_seeds(config.seed, Purpose.EVALUATION, 2, count=len(chosen))
    outcome = evaluate_policy(env, policy, chosen.contexts, seeds, gamma=config.learner.gamma)
    names = ("return", "discounted_return", "length", "success")
    columns = (outcome.returns, outcome.discounted_returns, outcome.lengths, outcome.success)
    means = {
        name: None if np.isnan(values).all() else float(np.mean(values))
        for name, values in zip(names, columns, strict=True)
    }
    if out is not None:
        rows = zip(chosen.ids.tolist(), *(values.tolist() for values in columns), strict=True)
        lines = [f"id,{','.join(names)}", *(",".join(map(str, row)) for row in rows)]
        _write(out, "\n".join(lines) + "\n")
    if as_json:
        print(json.dumps({"run": str(run), "steps": status.steps, "state": status.state, "instances": str(instances),
                          "n_instances": len(chosen), **means}))  # fmt: skip
        return
    table = Table(title=f"{config.name}, seed {config.seed}, after {status.steps:,} steps ({status.state})")
    for name in ("instances", *names):
        table.add_column(name.replace("_", " "), justify="right")
    shown = ["—" if value is None else f"{value:.3f}" for value in means.values()]
    table.add_row(str(len(chosen)), *shown)
    console.print(table)


@app.command()
def report(
    runs: Runs,
    out: Annotated[Path, typer.Option(help="Folder for the figure and the tables.")] = Path("report"),
) -> None:
    """Compare runs: a figure and a table with 95 % bootstrap intervals over seeds."""
    from space_dist.ledger import find_ledgers
    from space_dist.report import build_report

    print_report(build_report(find_ledgers(runs), out), console)


def print_report(result: Report, to: Console) -> None:
    """Show a report's table, its caveats, and where the files are."""
    # One block per configuration where the terminal is too narrow for a row of so many columns.
    wide = to.width >= _REPORT_WIDTH
    if wide:
        table = Table()
        for column in result.table[0]:
            table.add_column(column)
        for row in result.table:
            table.add_row(*(text.replace("[", r"\[") for text in row.values()))
    else:
        table = Table("", *(row["configuration"] for row in result.table))
        for column in list(result.table[0])[1:]:
            table.add_row(column, *(row[column].replace("[", r"\[") for row in result.table))
    to.print(table)
    for remark in result.remarks:
        to.print(remark, highlight=False, markup=False)
    to.print(f"Figure and tables: {result.figure.parent}", highlight=False, soft_wrap=True)


@app.command()
def sync(
    runs: Runs,
    uri: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Tracking URI; default: each run's own (tracking.uri)."),
    ] = None,
    experiment: Annotated[Optional[str], typer.Option(help="MLflow experiment.")] = None,  # noqa: UP045
    follow: Annotated[bool, typer.Option("--follow", help="Go on until the runs have ended.")] = False,
) -> None:
    """Replay runs into MLflow. Doing it twice changes nothing."""
    from space_dist.ledger import find_ledgers
    from space_dist.tracking import follow as follow_runs
    from space_dist.tracking import sync as sync_runs

    ledgers = find_ledgers(runs)
    if follow:
        result = follow_runs(
            runs, uri, experiment, stop=lambda: not any(ledger.owner_alive() for ledger in ledgers)
        )  # fmt: skip
    else:
        result = sync_runs(ledgers, uri, experiment)
    console.print(
        f"{result.runs} runs are up to date in MLflow ({result.created} new, {result.rows} rows pushed"
        + (f", {result.skipped} have no tracking.uri)" if result.skipped else ")"),
        highlight=False,
    )
    for folder, reason in result.failed.items():
        errors.print(f"space-dist: {folder} is not mirrored: {reason}", highlight=False, markup=False, soft_wrap=True)
    if result.failed:
        raise typer.Exit(1)


@instances_app.command("sample")
def instances_sample(
    distribution: Annotated[str, typer.Argument(help="pointmass_uniform, pointmass_target, ...")],
    out: Annotated[Path, typer.Option(help="Folder for <distribution>_train.csv and <distribution>_test.csv.")],
    n_train: Annotated[int, typer.Option("--train", min=1, max=10_000_000, help="Training instances.")] = 100,
    n_test: Annotated[int, typer.Option("--test", min=1, max=10_000_000, help="Test instances.")] = 100,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1)] = 0,
) -> None:
    """Draw disjoint training and test instances."""
    from space_dist.instances import sample

    train_set, test_set = sample(distribution, n_train, n_test, seed)
    for name, chosen in (("train", train_set), ("test", test_set)):
        path = out / f"{distribution}_{name}.csv"
        if path.exists():
            raise ConfigError(f"{path} exists; choose another --out, or remove it")
        _write(path, chosen.to_csv())
        console.print(f"{path}: {len(chosen)} instances", highlight=False, markup=False, soft_wrap=True)


@instances_app.command("check")
def instances_check(
    files: Annotated[list[Path], typer.Argument(help="CSV files; given two, they must not share a context.")],
    env: Annotated[str, typer.Option(help="The environment whose contexts these are.")] = "space_dist/PointMass-v0",
) -> None:
    """Check instance files and show what is in them."""
    from space_dist.envs import make_batched
    from space_dist.instances import read_csv, refuse_overlap, summary

    bounds = make_batched(env, 1, context_visible=False).context_bounds
    sets = [read_csv(file, bounds) for file in files]
    for index, one in enumerate(sets):
        for other in range(index):
            refuse_overlap(sets[other], one, str(files[other]), str(files[index]))
    for file, one in zip(files, sets, strict=True):
        table = Table(title=f"{file}: {len(one)} instances")
        for name in ("feature", "least", "mean", "greatest", "bounds"):
            table.add_column(name, justify="left" if name == "feature" else "right")
        for row, low, high in zip(summary(one, bounds), bounds.low, bounds.high, strict=True):
            table.add_row(row[0], *(f"{value:.4g}" for value in row[1:]), f"[{low:g}, {high:g}]")
        console.print(table)


@config_app.command("schema")
def config_schema() -> None:
    """Explain every key: type, default, meaning, unit and source."""
    from space_dist.config import schema

    for key, kind, default, text in schema():
        if kind == "section":
            console.print(f"\n[bold]{key}[/bold]  {text}", highlight=False)
        else:
            about_it = kind if default == "required" else f"{kind}, default {default}"
            required = " (required)" if default == "required" else ""
            console.print(f"  [bold]{key}[/bold]: {escape(about_it)}{required}", highlight=False)
            console.print(Padding(escape(text), (0, 0, 0, 6)), highlight=False)


@config_app.command("check")
def config_check(
    config: Annotated[Path, typer.Argument(help="A run's YAML file.")],
    overrides: Overrides = None,
) -> None:
    """Check a config and its instance files, and print it with every default written out."""
    from space_dist import config as configs
    from space_dist.launch import about, read_instances
    from space_dist.training import make_setup

    run = configs.load(config, list(overrides or []))
    with about(str(config)):
        make_setup(run, *read_instances(run))
    print(configs.dump(run), end="")


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None


@contextlib.contextmanager
def _display(name: str, seed: int) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on a terminal; nothing anywhere else."""
    if not console.is_terminal:
        yield lambda progress: None
        return
    from rich import progress as rich_progress

    def number(value: float | None) -> str:
        return "—" if value is None else f"{value:.2f}"

    bar = rich_progress.Progress(
        rich_progress.TextColumn("[bold]{task.description}"),
        rich_progress.BarColumn(),
        rich_progress.TextColumn("{task.fields[line]}"),
        rich_progress.TimeRemainingColumn(),
        console=console,
    )
    with bar:
        task = bar.add_task(f"{name} s{seed}", total=None, line="starting")

        def observe(progress: Progress) -> None:
            line = (
                f"{progress.steps:,}/{progress.budget_steps:,} steps  {progress.steps_per_second:,.0f}/s  "
                f"set {progress.set_size}/{progress.n_instances}  "
                f"return train {number(progress.train_return)} test {number(progress.test_return)}"
            )
            bar.update(task, completed=progress.steps, total=progress.budget_steps, line=line)

        yield observe


def main() -> None:
    """Run a command; every error that a user can cause ends it with one sentence and its exit code."""
    sys.path.append(str(Path.cwd()))  # import paths in configs may name the user's own modules
    try:
        app()
    except SpaceDistError as error:
        for line in str(error).splitlines():
            errors.print(f"space-dist: {line}", highlight=False, markup=False, soft_wrap=True)
        sys.exit(error.exit_code)
    except Exception as error:
        # Nobody wants a traceback on their terminal; who does says so.
        if os.environ.get("SPACE_DIST_TRACEBACK"):
            raise
        what = f"{type(error).__name__}: {str(error)[:300]}"
        hint = "SPACE_DIST_TRACEBACK=1 shows where"
        errors.print(f"space-dist: unexpected: {what} ({hint})", highlight=False, markup=False, soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
