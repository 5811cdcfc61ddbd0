"""Commands about runs: train, evaluate, explain, report, sync, export-sb3."""

from __future__ import annotations

import contextlib
import datetime
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from space_dist.cli.terminal import STOP, Json, Overrides, console, delivered, one_run, say, warn, write
from space_dist.errors import ConfigError, about, counted, exits_refused

if TYPE_CHECKING:
    from space_dist.config import BudgetConfig
    from space_dist.experiment.manifest import Grid
    from space_dist.report import GridReport, Report
    from space_dist.run.launch import Outcome
    from space_dist.run.training import Progress

_REPORT_WIDTH = 200  # characters
_GRID_WIDTH = 150
_MAX_CELLS_SHOWN = 60
_MAX_NAMED = 5  # folders in a line
_BAR_WIDTH = 20
_LINE_WIDTH = 114  # beside a bar
_LINE_SECONDS = 10.0  # between lines of progress


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
    from space_dist.config.reading import from_option
    from space_dist.experiment.places import run_folder
    from space_dist.run.launch import launch
    from space_dist.system.workplace import default_folder, lasting

    options = [("--workers", "resources.workers", workers), ("--seed", "seed", seed)]
    settings = [from_option(*option) for option in options if option[-1] is not None]
    changes = [*(overrides or ()), *settings]
    run = configs.load(config, changes)
    folder = run_folder(lasting(out, "--out")) if out is not None else default_folder(run.name, run.seed)
    with about(str(config), configs.origins(changes)), _display(run.name, run.seed) as (observe, waiting):
        outcome = launch(
            run, folder, resume=resume, stop=STOP, observe=observe, waiting=waiting,
            tell=lambda sentence: warn(f"space-dist: {sentence}"),
            going_on=lambda where: say(f"{run.name} s{run.seed}: {where}"),
        )  # fmt: skip
    verb = "was already done" if outcome.already_done else "done"
    say(f"{run.name}, seed {run.seed}: {verb}, {_taken(outcome, run.budget)}. {folder}")
    _name_pages(outcome.pages)
    if outcome.tracking_warning:
        warn(f"warning: {outcome.tracking_warning}")


def _taken(outcome: Outcome, budget: BudgetConfig) -> str:
    """`40 of 40 episodes, 6,144 environment steps`, by what is on disk; and why steps of the budget were left over."""
    steps, ended, enough = outcome.ledger.status().steps, "", False
    if budget.episodes is not None:
        episodes = outcome.ledger.episodes()
        ended, enough = f"{episodes:,} of {budget.episodes:,} episodes, ", episodes >= budget.episodes
        if episodes > budget.episodes:  # rounds are whole
            ended = f"{episodes:,} episodes (the round in which episode {budget.episodes:,} ended was finished), "
    if enough or steps >= budget.steps:
        return f"{ended}{steps:,} environment steps"
    return f"{ended}{steps:,} of {budget.steps:,} environment steps: another update takes {outcome.next_round}"


def evaluate(
    run: Annotated[Path, typer.Argument(help="A run's folder.", callback=one_run)],
    instances: Annotated[Path, typer.Option(help="CSV of the instances to evaluate on.")],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Also write every instance's results to this CSV."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Evaluate a run's policy, deterministically, on any instances of its environment."""
    import numpy as np

    from space_dist.config import located
    from space_dist.envs import KnowsOptimum, unwrapped
    from space_dist.instances import read_csv
    from space_dist.ledger import Ledger, there
    from space_dist.rollout import Trial
    from space_dist.rollout import evaluate as evaluate_policy
    from space_dist.rollout.policy import policies_of
    from space_dist.run.building import spec_of
    from space_dist.run.claiming import stored_config
    from space_dist.run.launch import policy_of
    from space_dist.seeding import Purpose, episode_seeds

    ledger = Ledger(there(run))
    status = ledger.status()
    if out is not None:
        if out.resolve() == Path(located(instances)).resolve():
            raise ConfigError(f"--out {out} is the file of the instances, which would be lost; name another")
        if out.resolve().is_relative_to(ledger.folder.resolve()):
            raise ConfigError(f"--out {out} lies in the run's own folder; name a file elsewhere")
    state = "abandoned" if ledger.abandoned(status) else status.state
    config = stored_config(ledger)
    spec = spec_of(config)
    policies = policies_of(policy_of(ledger, spec))
    chosen = read_csv(instances, spec.context_bounds, config.columns_read, if_there=True)
    seeds = episode_seeds(config.seed, Purpose.EVALUATION, 2, count=len(chosen))
    optimum = None
    with exits_refused(), spec.opened(spec.slots_for(len(chosen))) as env:
        outcomes = [evaluate_policy(env, [Trial(policy, chosen.contexts, seeds, config.learner.gamma)])[0]
                    for policy in policies]  # fmt: skip
        if isinstance(world := unwrapped(env), KnowsOptimum):
            optimum = world.optimal_returns(chosen.contexts)
    names = {"return": "returns", "discounted_return": "discounted_returns", "length": "lengths", "success": "success"}
    columns = {  # over all policies, where the run trains several
        column: np.mean([getattr(outcome, name) for outcome in outcomes], axis=0) for column, name in names.items()
    }
    if optimum is not None:
        columns["optimal_return"] = optimum
    means = {name: None if np.isnan(values).all() else float(np.mean(values)) for name, values in columns.items()}
    if "optimal_return" in columns:  # a share of sums: no single episode's return need be positive
        means["share_of_optimum"] = float(columns["return"].sum() / columns["optimal_return"].sum())
    if out is not None:
        rows = zip(chosen.ids.tolist(), *(values.tolist() for values in columns.values()), strict=True)
        lines = [f"id,{','.join(columns)}", *(",".join(map(str, row)) for row in rows)]
        write(out, "\n".join(lines) + "\n")
    if as_json:
        print(json.dumps({"run": str(run), "steps": status.steps, "state": state, "instances": str(instances),
                          "n_instances": len(chosen), **means}))  # fmt: skip
        delivered()
        return
    table = Table(title=f"{config.name}, seed {config.seed}, after {status.steps:,} steps ({state})")
    for name in ("instances", *means):
        table.add_column(name.replace("_", " "), justify="right")
    shown = ["—" if value is None else f"{value:.3f}" for value in means.values()]
    table.add_row(str(len(chosen)), *shown)
    console.print(table)
    if out is None:
        delivered()


def explain(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    iteration: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="Which, counted from 1: the decision behind it is shown. Default: the last.", show_default=False
        ),
    ] = None,
) -> None:
    """Show one decision about a set, line by line of Algorithm 1, with its numbers (lines 6 to 13)."""
    from space_dist.instances import read_csv
    from space_dist.ledger import Ledger, there
    from space_dist.report.decisions import explain as explain_decision
    from space_dist.run.building import spec_of
    from space_dist.run.claiming import stored_config

    ledger = Ledger(there(run))
    ledger.status()
    config = stored_config(ledger)
    ledger.read(ledger.instances("train"))
    bounds = spec_of(config).context_bounds
    train = read_csv(ledger.instances("train"), bounds, config.columns_read)
    for line in explain_decision(ledger, config, bounds, train, iteration):
        print(line)
    delivered()


def export_sb3(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="The zip to write. Default: <name>_s<seed>.zip in the current folder."),
    ] = None,
) -> None:
    """Write a run's policy as a zip that Stable-Baselines3 loads."""
    from space_dist.ledger import Ledger, there
    from space_dist.run.claiming import stored_config
    from space_dist.sb3.export import export_sb3 as export

    ledger = Ledger(there(run))
    ledger.status()
    config = stored_config(ledger)
    for path, what in export(ledger, out or Path(f"{config.name}_s{config.seed}.zip")):
        say(f"{path}: {what}")


def report(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH...", help="A grid (folder or YAML file); or run folders, or their own."),
    ],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for figures and tables. Default: report; of a grid: report in the grid's folder."),
    ] = None,
    baseline: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="CELL", help="Of a grid: compare with this cell (label or id), not the grid's baseline."),
    ] = None,
    threshold: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="Of a grid: steps to this test return; default: to the baseline's final IQM."),
    ] = None,
    root: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Of a grid's YAML file: folder that holds the grids' folders, as of `space-dist grid`."),
    ] = None,
    scale: Annotated[float, typer.Option(help="Of a grid's YAML file: the scale at which it was run.")] = 1.0,
    changes: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--set", metavar="KEY=VALUE", help="Of a grid's YAML file: with what it was run. Repeatable."),
    ] = None,
) -> None:
    """Compare runs, or the cells of a grid: figures and tables with 95 % intervals over seeds."""
    from space_dist.api.reports import is_grid, not_begun
    from space_dist.config import located
    from space_dist.experiment.manifest import in_root
    from space_dist.ledger import find_ledgers
    from space_dist.report import build_grid_report, build_report
    from space_dist.system.workplace import workplace

    paths = [located(path) for path in paths]
    if len(paths) == 1:
        paths = [in_root(paths[0], workplace() / "runs" if root is None else root)]
    if len(paths) == 1 and is_grid(paths[0]):
        grid = _grid(paths[0], root, scale, changes or ())
        print_grid_report(build_grid_report(grid, out, baseline=baseline, threshold=threshold), console)
        return
    if baseline is not None and (absent := [str(path) for path in paths if not path.exists()]):
        label = " ".join([baseline, *absent])
        raise ConfigError(f"{absent[0]} does not exist; a label of several words goes in quotes: --baseline '{label}'")
    if grids := [path for path in paths if is_grid(path)]:
        raise ConfigError(f"{grids[0]} is a grid: give it alone, for each grid has a report of its own")
    if baseline is not None or threshold is not None or scale != 1.0 or changes:
        raise ConfigError(f"--baseline, --threshold, --scale and --set are for grids; {paths[0]} is none")
    ledgers = find_ledgers(paths)
    folder = Path("report") if out is None else out
    print_report(build_report(ledgers, folder, not_begun=not_begun(paths, ledgers)), console)


def _grid(path: Path, root: Path | None, scale: float, changes: Sequence[str]) -> Grid:
    from space_dist.experiment.manifest import find_grid
    from space_dist.system.workplace import workplace

    return find_grid(path, workplace() / "runs" if root is None else root, scale, changes)


def print_report(result: Report, to: Console) -> None:
    """Show a report's table, its caveats, and where the files are."""
    # Rich takes brackets for markup: those of names and intervals are to be seen.
    if to.width >= _REPORT_WIDTH:
        table = Table()
        for column in result.table[0]:
            table.add_column(column)
        for row in result.table:
            table.add_row(*(text.replace("[", r"\[") for text in row.values()))
        to.print(table)
    else:
        table = Table("", *(row["configuration"].replace("[", r"\[") for row in result.table))
        for column in list(result.table[0])[1:]:
            table.add_row(column, *(row[column].replace("[", r"\[") for row in result.table))
        if to.measure(table, options=to.options.update(max_width=_REPORT_WIDTH)).maximum <= to.width:
            to.print(table)
        else:  # cut off, two configurations may look alike
            _print_blocks(result.table, to)
    for remark in result.remarks:
        to.print(remark, highlight=False, markup=False)
    to.print(f"Figure and tables: {result.figure.parent.absolute()}", highlight=False, markup=False, soft_wrap=True)


def _print_blocks(rows: Sequence[Mapping[str, str]], to: Console) -> None:
    """A block of lines for each row, under its first text."""
    for row in rows:
        name, *others = row.items()
        to.print(f"\n{name[1]}", style="bold", highlight=False, markup=False)
        for column, text in others:
            to.print(f"  {column}: {text}", highlight=False, markup=False)


def print_grid_report(result: GridReport, to: Console) -> None:
    """Show what a grid's report says in short, and where the whole of it is."""
    for sentence in result.summary:
        to.print(sentence, highlight=False, markup=False)
    rows = result.table[:_MAX_CELLS_SHOWN]
    if to.width >= _GRID_WIDTH:
        table = Table(*rows[0])
        for row in rows:
            table.add_row(*map(escape, row.values()))
        to.print(table)
    else:
        _print_blocks(rows, to)
    if len(result.table) > len(rows):
        to.print(f"... and {len(result.table) - len(rows):,} more cells, all in cells.csv.", highlight=False)
    for remark in result.remarks:
        to.print(remark, highlight=False, markup=False)
    to.print(f"Report: {result.folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def sync(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN|GRID...", help="Runs' or grids' folders, folders that hold some, or grids' YAML files."
        ),
    ],
    uri: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Tracking URI; default: each run's or grid's own (tracking.uri)."),
    ] = None,
    experiment: Annotated[Optional[str], typer.Option(help="MLflow experiment.")] = None,  # noqa: UP045
    follow: Annotated[
        bool, typer.Option("--follow", help="Go on until nobody works on the grids, and the runs have ended.")
    ] = False,
    root: Annotated[Path, typer.Option(help="Where the grids of YAML files are.")] = Path("runs"),
) -> None:
    """Replay runs and grids into MLflow. Doing it twice changes nothing."""
    from space_dist.config import located
    from space_dist.experiment.manifest import find_grid, in_root
    from space_dist.tracking import find
    from space_dist.tracking import follow as follow_runs
    from space_dist.tracking import sync as sync_runs
    from space_dist.tracking.store import usable_uri

    place = "the tracking.uri of each of them" if uri is None else f"MLflow at {usable_uri(uri)}"
    named = [located(path) for path in runs]
    paths = [
        find_grid(path, root).folder if path.is_file() else path for path in (in_root(path, root) for path in named)
    ]
    found = find(paths)
    say(f"mirroring {', '.join(map(str, runs))} to {place}")
    if follow:
        result = follow_runs(paths, uri, experiment)
    else:
        result = sync_runs(found.ledgers, uri, experiment, grids=found.grids, tell=say)
    mirrored = f"{counted(result.runs, 'run')} {'is' if result.runs == 1 else 'are'}"
    console.print(
        f"{mirrored} up to date in MLflow ({result.created} new, {result.rows} rows pushed"
        + (f", {result.skipped} have no tracking.uri)" if result.skipped else ")"),
        highlight=False,
    )
    _name_pages(result.pages)
    _name_failures(result.failed)
    if result.failed:
        raise typer.Exit(1)


def _name_failures(failed: Mapping[Path, str]) -> None:
    """Which runs and grids could not be mirrored: those of one reason, such as a dead server, in one line."""
    for reason in dict.fromkeys(failed.values()):
        folders = [str(folder) for folder, why in failed.items() if why == reason]
        more = f" and {len(folders) - _MAX_NAMED} more" if len(folders) > _MAX_NAMED else ""
        are = "is" if len(folders) == 1 else "are"
        warn(f"space-dist: {', '.join(folders[:_MAX_NAMED])}{more} {are} not mirrored: {reason}")


def _name_pages(pages: Iterable[str]) -> None:
    from space_dist.tracking.pusher import LOOK_AT

    shown = list(pages)
    for page in shown[:_MAX_NAMED]:
        say(f"{LOOK_AT}{page}")
    if len(shown) > _MAX_NAMED:
        say(f"... and {len(shown) - _MAX_NAMED:,} more places like these")


@contextlib.contextmanager
def _display(name: str, seed: int) -> Iterator[tuple[Callable[[Progress], None], Callable[[str], None]]]:
    """Who is told of progress, and of what is waited for: a progress bar on a terminal, lines anywhere else."""
    if not console.is_terminal:
        yield _lines(f"{name} s{seed}")
        return
    from rich import progress as rich_progress

    title = f"{name} s{seed}"
    wide = console.width >= len(title) + _BAR_WIDTH + _LINE_WIDTH
    bar = rich_progress.Progress(
        rich_progress.TextColumn("[bold]{task.description}"),
        *([rich_progress.BarColumn(_BAR_WIDTH)] if wide else []),
        rich_progress.TextColumn("{task.fields[line]}"),
        console=console,
    )
    with bar:
        task = bar.add_task(title, total=None, line="reading instances and environment")

        def observe(progress: Progress) -> None:
            line = in_words(progress, console.width - len(title) - 1)
            bar.update(task, completed=progress.share, total=1.0, line=line)

        yield observe, lambda what: bar.update(task, line=what)


def _lines(title: str) -> tuple[Callable[[Progress], None], Callable[[str], None]]:
    """The same as lines: what is waited for, and progress now and then."""
    said_at = -_LINE_SECONDS

    def observe(progress: Progress) -> None:
        nonlocal said_at
        now = time.monotonic()
        if now - said_at < _LINE_SECONDS and progress.share < 1:
            return
        said_at = now
        say(f"{title}: {in_words(progress)}")

    return observe, lambda what: say(f"{title}: {what}")


def in_words(progress: Progress, width: int | None = None) -> str:
    """How far a run is, in so many characters if that can be: what matters least is left out, first of all."""
    seconds = progress.seconds_left
    left = "" if seconds is None else f"{datetime.timedelta(seconds=round(seconds))} left"
    returns = progress.returns
    done, steps = [progress.so_far, progress.pace, left], progress.so_far.removesuffix(" steps")
    lines = (
        [*done, f"set {progress.trained}", f"return {returns}"],
        [*done, f"return {returns}"],
        [*done, returns],
        [steps, progress.pace, left, returns],
        [steps, progress.pace, left.removesuffix(" left"), returns],
        [steps, left or progress.pace, returns],
        [steps, left.removesuffix(" left") or progress.pace, returns],
        [steps, left or progress.pace, returns.partition(" at ")[0]],
    )
    for parts in lines:
        line = "  ".join(filter(None, parts))
        if width is None or len(line) <= width:
            break
    return line
