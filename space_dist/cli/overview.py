"""How a grid stands, for people: the table of what runs now, its cells, what failed, and one line of all that."""

from __future__ import annotations

import contextlib
import datetime
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rich.live import Live
from rich.table import Table
from rich.text import Text

from space_dist.cli.terminal import console, say
from space_dist.errors import SpaceDistError, counted
from space_dist.experiment.endings import Cause

if TYPE_CHECKING:
    from space_dist.experiment.manifest import Cell, Grid, Manifest
    from space_dist.experiment.status import RunStatus
    from space_dist.grid.conductor import Overview
    from space_dist.grid.planning import Plan
    from space_dist.ledger import Ledger
    from space_dist.slurm.queue import Queue

_LOG_SECONDS = 30.0
_SHOWN_RUNS = 12
_IDLE_LOOKS = 2  # of --watch
_ANY_WIDTH = 10_000  # characters
_COUNT_SECONDS = 5.0  # between two looks at how far all running runs are
_ENOUGH_SECONDS = 10.0  # of stepping, before which a rate says little: two such looks


@contextlib.contextmanager
def display(manifest: Manifest, place: Grid) -> Iterator[Callable[[Overview], None]]:
    """On a terminal a table of what runs now; elsewhere a line now and then."""
    time_left = _TimeLeft(place)
    if console.is_terminal:
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            yield lambda overview: live.update(_live_table(manifest, place, overview, time_left.in_words(overview)))
        return
    logged_at = 0.0
    logged: tuple[object, ...] = ()

    def observe(overview: Overview) -> None:
        nonlocal logged_at, logged
        line = (
            f"{manifest.name}: {overview.done} of {overview.total} done, {len(overview.running)} running, "
            f"{overview.waiting} waiting, {overview.failed} failed{time_left.in_words(overview)}"
        )
        if overview.message:
            line += f" (last: {overview.message})"
        news = (overview.done, overview.failed, overview.message)
        if time.monotonic() - logged_at > _LOG_SECONDS or news != logged:
            logged_at, logged = time.monotonic(), news
            say(line)

    yield observe


class _TimeLeft:
    """How much a grid still takes, and how long, at the rate of what was seen of it since its first run stepped."""

    def __init__(self, place: Grid) -> None:
        self._place = place
        self._at_first: int | None = None  # what was left when we looked first
        self._stepping: tuple[float, int] | None = None  # when we saw a run step first, and what was left then
        self._looked, self._done, self._words = 0.0, 0, ""

    def in_words(self, overview: Overview) -> str:
        """`, 614,400 steps left, about 0:12:00`, or episodes where these end runs; the time as soon as it can be told.

        Nothing where episodes end some runs, and not the others.
        """
        if overview.by_episodes and overview.episodes_left is None:
            return ""
        now = time.monotonic()
        if now - self._looked >= _COUNT_SECONDS or overview.done != self._done or not overview.steps_left:
            self._looked, self._done, self._words = now, overview.done, self._estimated(overview, now)
        return self._words

    def _estimated(self, overview: Overview, now: float) -> str:
        if overview.episodes_left is None:
            what, budgets, so_far = "steps", overview.steps_left, _steps_of
        else:
            what, budgets, so_far = "episodes", overview.episodes_left, episodes_of
        taken = sum(so_far(self._place.ledger(run)) for run in overview.running)
        left = max(0, budgets - taken)
        if self._at_first is None:
            self._at_first = left
        if not left:
            return ""
        if self._stepping is None and left < self._at_first:
            self._stepping = now, left
        if self._stepping is None:
            return f", {left:,} {what} left" + (", starting" if overview.running else "")
        seconds, done = now - self._stepping[0], self._stepping[1] - left
        enough = done > 0 and seconds >= _ENOUGH_SECONDS
        about = f", about {datetime.timedelta(seconds=round(left * seconds / done))}" if enough else ""
        return f", {left:,} {what} left{about}"


def _steps_of(ledger: Ledger) -> int:
    """How far a run is, by its last row, which is newer than its last checkpoint; 0 before it has one."""
    from space_dist.experiment.status import last_lines
    from space_dist.ledger import METRICS, decode_row

    for line in reversed(last_lines(ledger.folder / METRICS, 2)):  # the last may be half written
        row = decode_row(line.encode() + b"\n")
        if row is not None and isinstance(row.get("steps"), int):
            return int(row["steps"])
    return 0


def episodes_of(ledger: Ledger) -> int:
    """The same in training episodes; 0, too, of a run whose rows cannot be read now."""
    with contextlib.suppress(SpaceDistError):
        return ledger.episodes()
    return 0


def _live_table(manifest: Manifest, place: Grid, overview: Overview, time_left: str) -> Table:
    from space_dist.ledger import CURRICULUM

    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(overflow="fold")
    done = overview.done / max(1, overview.total)
    bar = "█" * round(24 * done) + "░" * (24 - round(24 * done))
    counts = f"{overview.done} of {overview.total} runs done"
    counts += f", {overview.failed} failed" if overview.failed else ""
    table.add_row(Text(manifest.name, style="bold"), Text(f"{bar} {counts}, {overview.waiting} waiting{time_left}"))
    for run in overview.running[:_SHOWN_RUNS]:
        ledger, line = place.ledger(run), "starting"
        with contextlib.suppress(SpaceDistError, KeyError, IndexError):
            sets, rows = ledger.rows(CURRICULUM), ledger.rows()
            evaluations = [row for row in rows if row["kind"] == "evaluation"]
            shown = f"{evaluations[-1]['test']['return']:.3g}" if evaluations else "—"
            # A set is written when its iteration ends: behind an evaluation that came with its first update, say.
            steps = max((row["steps"] for row in (*rows[-1:], *sets[-1:])), default=0)
            size = len(sets[-1]["trained"]) if sets else "—"
            taken = f"{steps:>10,} of {run.cell.steps_to_take:,} steps"
            if (limit := run.cell.episodes_to_take) is not None:
                taken += f", {episodes_of(ledger):,} of {limit:,} episodes"
            line = f"{taken}   set {size}   test return {shown}"
        table.add_row(Text(run.title), Text(line))
    if len(overview.running) > _SHOWN_RUNS:
        table.add_row("", Text(f"and {len(overview.running) - _SHOWN_RUNS} more"))
    if overview.message:
        table.add_row(Text("last", style="red"), Text(overview.message))
    return table


def fits(table: Table) -> bool:
    """Whether a terminal of this width shows a table without breaking anything in it."""
    return console.measure(table, options=console.options.update(max_width=_ANY_WIDTH)).maximum <= console.width


def print_cells(manifest: Manifest, found: Sequence[RunStatus]) -> None:
    """How the seeds of each cell stand: a line for each, and a label's whole words, whatever the terminal's width."""
    of_cell: dict[str, list[RunStatus]] = {cell.id: [] for cell in manifest.cells}
    for run_status in found:
        of_cell[run_status.run.cell.id].append(run_status)
    rows = [_cell_row(cell, of_cell[cell.id]) for cell in manifest.cells]
    if not rows:  # a search all of whose settings were refused so far
        say(f"{manifest.name} has no cells yet")
        return
    table = Table(title=Text(manifest.name), title_justify="left")
    for column in rows[0]:
        table.add_column(column, justify="left" if column in ("cell", "id") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row.values()))
    if fits(table):
        console.print(table)
        return
    say(manifest.name)
    for row in rows:
        say(row["cell"])
        say("  " + ", ".join(f"{column} {text}" for column, text in row.items() if text and column != "cell"))


def _cell_row(cell: Cell, found: Sequence[RunStatus]) -> dict[str, str]:
    counts = Counter(run_status.condition for run_status in found)
    steps = sum(run_status.steps for run_status in found)
    # A run that is done has none left, though another update may not have fitted into its budget.
    of_all = sum(one.steps if one.condition == "done" else one.budget_steps for one in found)
    episodes = "" if cell.episodes_to_take is None else f", at most {counted(cell.episodes_to_take, 'episode')} a run"
    return {
        "cell": cell.label, "id": cell.id, "done": f"{counts['done']}/{len(found)}",
        **{condition: str(counts[condition] or "") for condition in ("running", "waiting", "failed")},
        "steps": f"{steps / max(1, of_all):.0%} of {of_all:,}{episodes}",
    }  # fmt: skip


def planned_steps(made: Plan) -> str:
    """What the runs of a planned grid take; where their budgets, which its cells show, are more, those, too."""
    budgets = sum(run.cell.budget_steps for run in made.manifest.runs())
    budgeted = "" if made.steps == budgets else f" (budgets: {budgets:,}, which no further update fits into)"
    most = "at most " if made.at_most else ""
    return f"{most}{made.steps:,} environment steps in whole updates{budgeted}{_or_episodes(made.manifest)}"


def _or_episodes(manifest: Manifest) -> str:
    """What else ends the runs of a grid than their steps."""
    limits = {cell.episodes_to_take for cell in manifest.cells}
    if limits == {None}:
        return ""
    [limit, *others] = limits
    return (
        ", or fewer, where episodes end runs" if others or limit is None else f", or {counted(limit, 'episode')} a run"
    )


def print_stand(
    place: Grid, manifest: Manifest, found: Sequence[RunStatus], by_cause: bool, queue: Queue | None
) -> None:  # fmt: skip
    """All that `grid status` shows of a grid."""
    print_cells(manifest, found)
    print_failures(found, by_cause)
    say(summary(manifest, found) + workers_in_words(place, queue))


def print_failures(found: Sequence[RunStatus], by_cause: bool) -> None:
    """What is wrong with the runs that failed or wait for another attempt; with `by_cause` all of them, by cause."""
    unwell = [run_status for run_status in found if run_status.cause is not None and run_status.condition != "done"]
    if by_cause:
        for cause, count in sorted(Counter(run_status.cause for run_status in unwell if run_status.cause).items()):
            say(f"{cause.in_words}: {count}")
            for run_status in unwell:
                if run_status.cause is cause:
                    run = run_status.run
                    say(f"  {run.title} ({run.cell.id}): {run_status.condition}{_why(run_status)}")
        for way, count in Counter(one.way_out for one in unwell if one.condition == "failed").items():
            say(f"{counted(count, 'run')} failed for good; {way}")
        return
    for run_status in unwell[:_SHOWN_RUNS]:
        say(f"{run_status.run.title}: {run_status.in_words}{_why(run_status)}")
    if len(unwell) > _SHOWN_RUNS:
        say(f"and {len(unwell) - _SHOWN_RUNS} more: --by-cause shows all")
    for way in dict.fromkeys(one.way_out for one in unwell if one.condition == "failed"):
        say(way)


def _why(run_status: RunStatus) -> str:
    """What is known beside the cause. Who stops a run knows why: nothing is missing there."""
    lines = run_status.detail.splitlines()
    if lines:
        return f"; {lines[0][:300]}"
    return "" if run_status.cause is Cause.STOPPED else "; no more is known"


def summary(manifest: Manifest, found: Sequence[RunStatus]) -> str:
    """How many runs are done, running, waiting and failed."""
    counts = Counter(run_status.condition for run_status in found)
    parts = [f"{counts[condition]} {condition}" for condition in ("running", "waiting", "failed") if counts[condition]]
    other = sum(run_status.other_code for run_status in found)
    parts += [f"{other} of the done ones by another version of this package"] if other else []
    return ", ".join([f"{manifest.name}: {counts['done']} of {len(found)} runs done", *parts])


def workers_in_words(place: Grid, queue: Queue | None) -> str:
    """Who works on the grid: what Slurm says of its jobs, or whether anybody does."""
    if queue is not None:
        logs = place.folder / "logs"
        over = queue.answered and not queue.live and logs.is_dir()
        return f"\n{queue.in_words()}" + (f"; what the jobs said is in {logs}" if over else "")
    return "" if place.owner_alive() else "; nobody is working on it now"


class Watching:
    """When `--watch` is over: when nothing is left to do, or nobody works any more on what somebody has worked on."""

    def __init__(self, *, begun: bool = False) -> None:
        """begun: whether somebody has worked on it before."""
        self._begun, self._idle = begun, 0

    def is_over(self, place: Grid, queue: Queue | None, found: Sequence[RunStatus]) -> bool:
        """Told at each look. What Slurm says may be late, and was idle twice before it is believed."""
        working = place.owner_alive() or bool(queue and queue.live) or any(one.condition == "running" for one in found)
        self._begun, self._idle = self._begun or working, 0 if working else self._idle + 1
        return self._begun and self._idle >= _IDLE_LOOKS


def tell(manifest: Manifest, place: Grid, found: Sequence[RunStatus]) -> int:
    """Say how a grid ended; returns the exit code."""
    from space_dist.experiment.status import exit_code

    print_failures(found, by_cause=False)
    say(f"{summary(manifest, found)}. {place.folder}")
    return exit_code(found)


def status_json(manifest: Manifest, place: Grid, found: Sequence[RunStatus]) -> dict[str, Any]:
    """How every run stands, for programs."""
    return {
        "grid": manifest.name, "folder": str(place.folder), "owner_alive": place.owner_alive(),
        "counts": dict(Counter(run_status.condition for run_status in found)),
        "runs": [
            {
                "cell": run_status.run.cell.id, "label": run_status.run.cell.label, "seed": run_status.run.seed,
                "condition": run_status.condition, "cause": run_status.cause, "detail": run_status.detail,
                "steps": run_status.steps, "budget_steps": run_status.budget_steps, "attempts": run_status.attempts,
                "other_code": run_status.other_code, "folder": str(run_status.ledger.folder),
            }
            for run_status in found
        ],
    }  # fmt: skip
