"""Commands about searches: plan, run, status, report, confirm. The rest is a grid's: `space-dist grid retry FOLDER`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer
from rich import box
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from space_dist.cli.grids import (
    Address,
    ClusterMode,
    MaxParallel,
    Nodes,
    Root,
    log_to,
    mode_of,
    prepare,
    print_json,
    root_of,
    run_statuses_of,
    started_ahead,
    tell_results_elsewhere,
)
from space_dist.cli.overview import Watching, display, fits, print_failures, status_json, summary, workers_in_words
from space_dist.cli.terminal import STOP, Json, console, output_left, say, warn
from space_dist.errors import ConfigError, counted
from space_dist.system.extras import needed_from

if TYPE_CHECKING:
    from space_dist.experiment.manifest import Grid, Manifest
    from space_dist.experiment.search import Search

_WATCH_SECONDS = 1.0
_FILES = (".yaml", ".yml")
_FAILED, _UNFINISHED = 1, 3  # exit codes of `tune status`


class _RunsFiles(TyperGroup):
    """`space-dist tune TUNE`, a search's file, folder or name, is `space-dist tune run TUNE`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Of the words behind `tune`, the first of which names a command, a file, a folder or a search."""
        if args and args[0] not in self.commands:
            named = args[0].endswith(_FILES) or args[0].startswith("shipped:") or Path(args[0]).is_dir()
            args = ["run", *args] if named or _is_in_root(args[0], args[1:]) else args
        return super().resolve_command(ctx, args)


def _is_in_root(name: str, words: Sequence[str]) -> bool:
    """Whether a search or grid is called so below the `--root` that is among these words."""
    if len(Path(name).parts) != 1:
        return False
    from space_dist.experiment.manifest import Grid

    named = next((word.partition("=")[2] for word in words if word.startswith("--root=")), None)
    behind = next((after for word, after in pairwise(words) if word == "--root"), named)
    return Grid(root_of(None if behind is None else Path(behind)) / name).manifest_file.exists()


tune_app = typer.Typer(
    cls=_RunsFiles, no_args_is_help=True,
    help="Search for settings, several seeds a trial, and confirm what was found. `tune FILE.yaml` runs a search.",
)  # fmt: skip

TunePath = Annotated[
    Path,
    typer.Argument(
        metavar="TUNE", help="A search's YAML file, its folder, or its name below --root.", show_default=False
    ),
]


@tune_app.command("plan")
def tune_plan(tune: TunePath, root: Root = None, as_json: Json = False) -> None:
    """Check a search, print what it comes to, and freeze it with its first trials."""
    with needed_from("tune", "a search"):
        from space_dist.grid.tuning import plan_search

    if tune.is_dir():
        raise ConfigError(f"{tune} is planned already; `space-dist tune status {tune}` tells how far it is")
    made = plan_search(tune, root_of(root))
    manifest, search = made.manifest, _search_of(made.grid, made.manifest)
    if as_json:
        print_json({"folder": str(made.grid.folder), "steps": made.steps, "new": made.new} | _numbers(search))
        return
    seeds = len(manifest.seeds)
    product = ((len(search.arms), "arm"), (search.config["trials"], "trial"), (seeds, "seed"))
    say(
        f"{' x '.join(counted(*factor) for factor in product)} = {counted(search.total * seeds, 'run')}, "
        f"{made.steps:,} environment steps"
        + (" at most: trials that are given up get fewer" if search.config["pruner"] else "")
    )
    for arm, record in search.arms.items():
        say(f"{arm}: {', '.join(record.space)}")
    _print_trials(search, [trial.cell for trial in search.trials if trial.generation == search.generation])
    say(f"{'frozen' if made.new else 'goes on'} in {made.grid.folder}")


@tune_app.command("run")
def tune_run(
    tune: TunePath,
    root: Root = None,
    max_parallel: MaxParallel = None,
    address: Address = "local",
    mode: ClusterMode = "auto",
    nodes: Nodes = 1,
) -> None:
    """Work through a search, generation by generation: skip what is done, go on with what is not."""
    chosen = mode_of(mode)
    prepare(address)
    with started_ahead(address, chosen) as server:
        from space_dist.api.tuning import planned, searched_through
        from space_dist.grid.conductor import working_on

        place = planned(tune, root_of(root))
        log_to(place)
        with working_on(place, place.manifest(), wait=True, stop=STOP, say=warn):
            manifest = searched_through(
                place, observing=lambda manifest: display(manifest, place), stop=STOP, address=address, mode=chosen,
                max_parallel=max_parallel, nodes=nodes, server=server, reinstall=STOP.install, say=say,
            )  # fmt: skip
    tell_outcome(place, manifest)
    say(f"`space-dist tune confirm {place.folder}` writes the grid that tells what it is worth")


@tune_app.command("status")
def tune_status(
    tune: TunePath,
    root: Root = None,
    watch: Annotated[bool, typer.Option("--watch", help="Go on showing until nothing is left to do.")] = False,
    as_json: Json = False,
    by_cause: Annotated[bool, typer.Option("--by-cause", help="Group what is not done by why.")] = False,
) -> None:
    """Where every trial stands. Exit codes: 0 over, 1 held up by failures, 3 unfinished, 2 there is no such search."""
    from space_dist.slurm.queue import WatchedQueue

    place = _found(tune, root_of(root))
    tell_results_elsewhere(place)
    watched, watching, shown = WatchedQueue(place.folder), Watching(), (dict[str, Any](), dict[str, Any]())
    while True:
        queue = watched.now()
        manifest = place.manifest()
        search = _search_of(place, manifest)
        waiting = {trial.cell for trial in search.open}
        found = run_statuses_of(place, manifest, [run for run in manifest.runs() if run.cell.id in waiting])
        settled = bool(found) and all(one.condition in ("done", "failed") for one in found)
        told = {"folder": str(place.folder), "owner_alive": place.owner_alive()} | _numbers(search)
        told |= {} if queue is None else {"slurm": queue.to_json()}
        now = told, status_json(manifest, place, found)
        if now == shown and not console.is_terminal:  # a file or a pipe keeps what it was told
            pass
        elif as_json:
            print_json(told)
        else:
            if watch and console.is_terminal:
                console.clear()
            _print_trials(search, [trial.cell for trial in search.trials])
            print_failures(found, by_cause)
            say(_summary(manifest, search))
            if found:
                say(f"now: {summary(manifest, found)}{workers_in_words(place, queue)}")
        shown = now
        idle = not place.owner_alive() and not (queue and queue.live)
        held_up = settled and any(one.condition == "failed" for one in found) and idle
        if not watch or output_left() or search.over or held_up or watching.is_over(place, queue, found):
            raise typer.Exit(0 if search.over else _FAILED if held_up else _UNFINISHED)
        time.sleep(_WATCH_SECONDS)


@tune_app.command("report")
def tune_report(
    tune: TunePath,
    root: Root = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for figures and tables. Default: report in the search's folder."),
    ] = None,
) -> None:
    """The search, the importance of its settings, and apart from it what was confirmed."""
    from space_dist.cli.runs import print_grid_report

    with needed_from("tune", "the report of a search"):
        from space_dist.report.search_report import build_search_report

    place = _found(tune, root_of(root))
    made = build_search_report(place, out)
    how_far, of_confirmation = made.summary
    say(how_far)
    if made.confirmation is None:
        say(of_confirmation)
    else:
        say("Confirmed with fresh seeds on the final instances:")
        print_grid_report(made.confirmation, console)
    say(f"Report of the search: {made.folder / 'report.html'}")


@tune_app.command("confirm")
def tune_confirm(tune: TunePath, root: Root = None) -> None:
    """Write the grid that runs the best setting of each arm with fresh seeds on the final instances."""
    from space_dist.experiment.tuning import confirmation_of
    from space_dist.slurm.export import JOBS

    with needed_from("tune", "a search"):
        from space_dist.grid.tuning import confirmation

    place = _found(tune, root_of(root))
    manifest = place.manifest()
    written = confirmation(place, manifest)
    search = _search_of(place, manifest)
    for arm in search.arms:
        best = search.best(arm)
        say(f"{arm}: trial {best.number if best is not None else ''}")
    say(
        f"`space-dist grid run {written} --root {place.folder.parent}` runs it; "
        f"`space-dist tune report {place.folder}` shows it"
    )
    if (place.folder / JOBS).exists():
        beside = place.folder.with_name(confirmation_of(manifest.name))
        say(f"on SLURM: `space-dist slurm export {written} --out {beside}`, with your --profile, then its submit.sh")


def tell_outcome(place: Grid, manifest: Manifest) -> None:
    """Say how a search ended. Raises typer.Exit if an arm has nothing to confirm."""
    search = _search_of(place, manifest)
    _print_failed(search)
    say(f"{_summary(manifest, search)}. {place.folder}")
    none = [arm for arm in search.arms if search.best(arm) is None]
    for arm in none:
        warn(f"arm {arm} has no complete trial, and so nothing to confirm")
    if none:
        raise typer.Exit(_FAILED)


# ---- parts ----------------------------------------------------------------------------------------------------------


def _found(tune: Path, root: Path) -> Grid:
    """A search that was planned before; where its file has changed since, that is said: it decides nothing here."""
    from space_dist.experiment.tuning import differences, find_tune

    place = find_tune(tune, root)
    changed = differences(tune, _search_of(place, place.manifest()).config)
    if changed:
        more = f" and {counted(len(changed) - 1, 'other key')}" if len(changed) > 1 else ""
        warn(
            f"{tune} has another {changed[0]}{more} than the search that {place.folder} holds, of which this tells; "
            "`space-dist tune plan` says whether it may still change"
        )
    return place


def _search_of(place: Grid, manifest: Manifest) -> Search:
    if manifest.search is None:
        raise ConfigError(f"{place.folder} holds a grid, and no search: space-dist grid status {place.folder}")
    return manifest.search


def _summary(manifest: Manifest, search: Search) -> str:
    counts = Counter(trial.state for trial in search.trials)
    parts = [f"{count} {state}" for state, count in sorted(counts.items())]
    copies = len(search.trials) - search.asked
    asked = f"{search.asked} of {search.total} trials asked" + (f", and {copies} copied members" if copies else "")
    return f"{manifest.name}: {asked}: {', '.join(parts)}"


def _print_trials(search: Search, cells: list[str]) -> None:
    """How the trials of each arm stand, and what those of these cells are; what they reached is the report's.

    Where the table is wider than the terminal, it is told in lines: no number is broken.
    """
    rows = [
        {
            "arm": trial.arm, "trial": str(trial.number), "from": str(trial.parent) if trial.parent >= 0 else "",
            "state": trial.state, "seeds": str(trial.seeds), "steps": f"{trial.steps:,}" if trial.steps else "",
            "setting": "\n".join(f"{key.rpartition('.')[2]}={value}" for key, value in trial.parameters.items()),
        }
        for trial in search.trials if trial.cell in cells
    ]  # fmt: skip
    # Of whom it is a copy, and where its runs are paused, is told where there is any such trial.
    told = [key for key in (rows[0] if rows else ()) if any(row[key] for row in rows)]
    table = Table(box=box.SIMPLE)
    for column in told:
        is_number = column in ("trial", "from", "seeds", "steps")
        table.add_column(column, justify="right" if is_number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(row[column]) for column in told))
    if rows and fits(table):
        console.print(table)
    else:
        for row in rows:
            _print_in_lines(row)


def _print_in_lines(trial: Mapping[str, str]) -> None:
    say(f"{trial['arm']}, trial {trial['trial']}")
    say(
        "  " + ", ".join(f"{column} {trial[column]}" for column in ("from", "state", "seeds", "steps") if trial[column])
    )
    for setting in trial["setting"].splitlines():
        say(f"  {setting}")


def _print_failed(search: Search) -> None:
    for trial in search.trials:
        if trial.state == "failed":
            warn(f"trial {trial.number} of {trial.arm} failed: {trial.remark}")


def _numbers(search: Search) -> dict[str, Any]:
    """For programs: every trial, and what it reached."""
    return {
        "generation": search.generation, "trials_in_all": search.total, "over": search.over,
        "counts": dict(Counter(trial.state for trial in search.trials)),
        "trials": [
            {
                "arm": trial.arm, "trial": trial.number, "generation": trial.generation, "cell": trial.cell,
                "state": trial.state, "seeds": trial.seeds, "steps": trial.steps or None, "rung": trial.rung,
                "parent": trial.parent if trial.parent >= 0 else None, "parameters": dict(trial.parameters),
                "values": {str(rung): value for rung, value in trial.values.items()}, "remark": trial.remark,
            }
            for trial in search.trials
        ],
    }  # fmt: skip
