"""A grid and its runs in words, as descriptions in Markdown: what was planned, where it stands, how it did."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from space_dist.experiment.manifest import Cell, Grid, Manifest
from space_dist.experiment.status import RunStatus
from space_dist.tracking.looking import Look
from space_dist.tracking.snapshot import MAX_TAG, as_params

CONDITIONS: Final = ("done", "running", "waiting", "failed")
_SHOWN_FAILURES, _SHOWN_VALUES = 5, 12


def describe(grid: Grid, manifest: Manifest, looks: Sequence[Look]) -> tuple[str, str | None]:
    """(Markdown that fits into a description: the plan, where it stands, the results; the results if cut, else None).

    looks: in the order of `manifest.runs()`.
    """
    plan = _plan(grid, manifest)
    status_lines = _status_lines(looks)
    head, *rows = _results(manifest, looks)
    whole = "\n".join([*plan, "", *status_lines, "", head, *rows])
    if len(whole) <= MAX_TAG:
        return whole, None
    shown, kept = [*plan, "", *status_lines, "", head], 0
    # 100: for the sentence that says how many cells are left out.
    room = MAX_TAG - 100 - len("\n".join(shown))
    for row in rows:
        room -= len(row) + 1
        if room < 0:
            break
        shown.append(row)
        kept += 1
    shown += ["", f"{len(rows) - kept} more cells are in results.md, among this run's artifacts."]
    return "\n".join(shown), "\n".join([f"# {manifest.name}", "", head, *rows, ""])


def describe_cell(cell: Cell, looks: Sequence[Look]) -> str:
    """A cell in Markdown. looks: at its runs."""
    counts = Counter(look.run_status.condition for look in looks)
    lines = [f"**{_cell_text(cell.label)}** over {_count(len(looks), 'seed')}", ""]
    lines.append("- " + ", ".join(f"{counts[name]} {name}" for name in CONDITIONS if counts[name]))
    if finals := [look.final for look in looks if look.final is not None]:
        from space_dist.report.statistics import intervals

        (found,) = intervals([np.array(finals, dtype=np.float64)], "iqm")
        bounds = (
            "" if found.low is None or found.high is None else f", 95 % interval {found.low:.4g} to {found.high:.4g}"
        )
        lines.append(
            f"- final return on the test instances: IQM {found.value:.4g}{bounds}, of {_count(len(finals), 'seed')}"
        )
    return "\n".join(lines)


def _plan(grid: Grid, manifest: Manifest) -> list[str]:
    cells, seeds, resources = manifest.cells, manifest.seeds, manifest.resources
    budgets = [cell.budget_steps for cell in cells] or [0]  # of a search, all of whose settings may be refused
    each = f"{budgets[0]:,}" if len({*budgets}) == 1 else f"{min(budgets):,} to {max(budgets):,}"
    runs = manifest.runs()
    made_of = f"{_count(len(cells), 'cell')} × {_count(len(seeds), 'seed')}"
    if manifest.search is not None:
        made_of = f"a search, {manifest.search.asked:,} of {_count(manifest.search.total, 'trial')} asked"
    lines = [
        f"**{_cell_text(manifest.name)}**: {made_of} = {_count(len(runs), 'run')} of {each} environment steps, "
        f"{sum(run.cell.budget_steps for run in runs):,} in all",
        "",
    ]
    if manifest.axes and manifest.search is None:
        lines += ["| varied | values |", "|---|---|"]
        for axis in manifest.axes:
            values = list(dict.fromkeys(_word(cell.settings[axis]) for cell in cells))
            more = f", … ({len(values)} in all)" if len(values) > _SHOWN_VALUES else ""
            shown = ", ".join(f"`{_cell_text(value[:80])}`" for value in values[:_SHOWN_VALUES])
            lines.append(f"| {_cell_text(axis)} | {shown}{more} |")
        lines.append("")
    consecutive = len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    named = f"{seeds[0]} to {seeds[-1]}" if consecutive else ", ".join(map(str, seeds[:50]))
    limits = [f"{_count(manifest.cpus_per_run, 'CPU')} ({_count(resources.workers, 'rollout actor')})"]
    limits += [f"{resources.memory_mb:,} MB"] if resources.memory_mb is not None else []
    limits += [f"{resources.minutes:g} minutes an attempt"] if resources.minutes is not None else []
    commit = manifest.git.get("git_commit")
    edited = ", edited since" if manifest.git.get("git_dirty") == "true" else ""
    return [
        *lines,
        f"- seeds {named}{', …' if not consecutive and len(seeds) > 50 else ''}",
        f"- each run may use {', '.join(limits)}",
        f"- code `{manifest.code}`" + (f", git commit `{commit}`{edited}" if commit else ""),
        f"- folder `{grid.folder}`",
    ]


def _status_lines(looks: Sequence[Look]) -> list[str]:
    counts = Counter(look.run_status.condition for look in looks)
    failed = [look.run_status for look in looks if look.run_status.condition == "failed"]
    words = [f"{counts[name]} {name}" for name in CONDITIONS if counts[name] and name != "failed"]
    words += [f"{len(failed)} failed ({_by_cause(failed)})"] if failed else []
    lines = [f"**{len(looks)} runs**: {', '.join(words)}"]
    if any(look.run_status.other_code for look in looks):
        count = sum(look.run_status.other_code for look in looks)
        lines += ["", f"{count} of the done were computed by another version of this package than this table."]
    if failed:
        lines.append("")
        for one in failed[:_SHOWN_FAILURES]:
            first = one.detail.splitlines()[0][:160] if one.detail else ""
            lines.append(f"- {one.run.title}: {one.cause.in_words if one.cause else 'failed'}. {_cell_text(first)}")
        if len(failed) > _SHOWN_FAILURES:
            lines.append(f"- and {len(failed) - _SHOWN_FAILURES} more")
    return lines


def _results(manifest: Manifest, looks: Sequence[Look]) -> list[str]:
    """The table's head, and a row for each cell."""
    from space_dist.report import interquartile_mean

    by_cell: dict[str, list[Look]] = {cell.id: [] for cell in manifest.cells}
    for look in looks:
        by_cell[look.run_status.run.cell.id].append(look)
    which = "test" if manifest.search is None else "development"
    rows = [
        f"Final return on the {which} instances, over the seeds that are done:\n\n"
        "| cell | id | IQM | mean | least | greatest | seeds done | failed |\n|---|---|---:|---:|---:|---:|---:|---|"
    ]
    for cell in manifest.cells:
        group = by_cell[cell.id]
        done = [look for look in group if look.run_status.condition == "done"]
        finals = np.array([math.nan if look.final is None else look.final for look in done], dtype=np.float64)
        numbers = ["—"] * 4
        if len(finals):
            numbers = [f"{x:.4g}" for x in (interquartile_mean(finals), finals.mean(), finals.min(), finals.max())]
        name = _cell_text(cell.label) + (" (baseline)" if cell.id == manifest.baseline else "")
        failed = [look.run_status for look in group if look.run_status.condition == "failed"]
        rows.append(
            f"| {name} | `{cell.id}` | {' | '.join(numbers)} | {len(done)}/{len(group)} | {_by_cause(failed)} |"
        )
    return rows


def _by_cause(failed: Sequence[RunStatus]) -> str:
    causes = Counter(one.cause.in_words if one.cause else "unknown" for one in failed)
    return ", ".join(f"{count} {cause}" for cause, count in causes.most_common())


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _word(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key.rpartition('.')[2]}={text}" for key, text in as_params(value).items())
    return as_params({"value": value})["value"]


def _cell_text(text: str) -> str:
    """Text that stays in its place of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def remark(look: Look) -> str:
    """Where a run stands in its grid, and what is known of the end of its last attempt."""
    one = look.run_status
    lines = [f"In its grid: {one.in_words}, after {_count(one.attempts, 'attempt')}"]
    if one.detail:
        lines += ["", *(f"    {line}" for line in one.detail[:2000].splitlines())]
    return "\n".join(lines)
