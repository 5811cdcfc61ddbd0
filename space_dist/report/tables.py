"""The same numbers three ways: for the terminal, as Markdown, as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from space_dist.report.load import SPLITS, Configuration, Run, Split, fingerprint_differences, standing
from space_dist.report.statistics import Estimate, estimate

NONE = "—"


@dataclass(frozen=True)
class Summary:
    """One configuration in numbers; all but `n_runs` are over its finished runs alone.

    Steps are real environment steps, None without a finished run. `test`, `train` and `test_success` are final means
    over the instances, in the environment's units. `set_size` is the median over seeds of the last set's size, None
    where contexts were generated. `reached` counts the runs that were trained on all their instances at once, from
    `reached_at` steps on (median over those).
    """

    label: str
    n_runs: int
    n_finished: int
    steps: tuple[float, int, int] | None  # median, least, most
    test: Estimate
    train: Estimate
    test_success: float
    set_size: float | None
    n_instances: float | None
    reached: int
    reached_at: float | None


def summarise(configuration: Configuration) -> Summary:
    """The numbers of one configuration."""
    runs = configuration.finished
    steps = [run.status.steps for run in runs]
    reached = [at for run in runs if (at := run.all_instances_reached_at) is not None]
    sized = [run for run in runs if run.trained and not run.generates_contexts]
    return Summary(
        label=configuration.label,
        n_runs=len(configuration.runs),
        n_finished=len(runs),
        steps=(float(np.median(steps)), min(steps), max(steps)) if steps else None,
        test=estimate(_finals(runs, "test", "return")),
        train=estimate(_finals(runs, "train", "return")),
        test_success=estimate(_finals(runs, "test", "success")).mean,
        set_size=float(np.median([run.set_size[1][-1] for run in sized])) if sized else None,
        n_instances=float(np.median([len(run.instance_ids) for run in sized])) if sized else None,
        reached=len(reached),
        reached_at=float(np.median(reached)) if reached else None,
    )


def remarks(configuration: Configuration) -> list[str]:
    """All that the table alone would hide about a configuration's runs, a sentence each."""
    label, lines = configuration.label, []
    unfinished = [run for run in configuration.runs if not run.finished]
    if unfinished:
        parts = [f"seed {run.status.seed} {standing(run)}" for run in unfinished]
        lines.append(f"{label}, not finished and not counted: {'; '.join(parts)}.")
    if unevaluated := [run for run in configuration.finished if not run.evaluated_at_end]:
        lines.append(f"{label}, finished but without a final evaluation, not counted in the returns: "
                     f"{_seeds(unevaluated)}.")  # fmt: skip
    counted = [run for run in configuration.finished if run.evaluated_at_end]
    for split in SPLITS:
        broken = [run for run in counted if math.isnan(run.final(split, "return"))]
        lines += [f"{label}: the final {split} return is not a finite number for {_seeds(broken)}, so there is none "
                  "over the seeds."] if broken else []  # fmt: skip
    if len({tuple(run.evaluation_steps.tolist()) for run in configuration.drawn}) > 1:
        lines.append(f"{label}: its seeds were evaluated at different steps; between its evaluations, and behind its "
                     "end, a run's last one is drawn.")  # fmt: skip
    for field, values in fingerprint_differences(configuration.runs).items():
        lines.append(f"{label}: its runs differ in {field}: {', '.join(values)}.")
    if moved := [run for run in configuration.runs if run.status.fingerprint_changed]:
        lines.append(f"{label}: resumed with another CPU model or other library versions: {_seeds(moved)}.")
    return lines


def cells(summary: Summary) -> dict[str, str]:
    """One row of the table as text: column -> cell."""
    size = NONE
    if summary.set_size is not None and summary.n_instances is not None:
        size = f"{summary.set_size:,g} of {summary.n_instances:,g}"
    reached = NONE
    if summary.n_finished and summary.set_size is not None:
        at = "" if summary.reached_at is None else f" at {summary.reached_at:,.0f} steps"
        reached = f"{summary.reached}/{summary.n_finished}{at}"
    return {
        "configuration": summary.label,
        "seeds finished": f"{summary.n_finished}/{summary.n_runs}",
        "environment steps": _steps(summary),
        "test return, IQM [95 %]": _interval(summary.test),
        "test return, mean": _number(summary.test.mean),
        "test return, median": _number(summary.test.median),
        "train return, IQM [95 %]": _interval(summary.train),
        "test success": _number(summary.test_success),
        "set size at the end": size,
        "all instances reached": reached,
    }


def to_markdown(rows: Sequence[dict[str, str]]) -> str:
    """A Markdown table of rows that all have the same columns."""
    lines = [[*rows[0]], ["---"] + ["---:"] * (len(rows[0]) - 1), *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def to_csv(summaries: Sequence[Summary]) -> str:
    """The numbers in full precision, a configuration a line; a number that does not exist is an empty cell."""
    rows = [_numbers(summary) for summary in summaries]
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _numbers(summary: Summary) -> dict[str, str | float | None]:
    median, least, most = summary.steps or (None, None, None)
    row: dict[str, str | float | None] = {
        "configuration": summary.label, "runs": summary.n_runs, "finished": summary.n_finished,
        "steps_median": median, "steps_min": least, "steps_max": most,
    }  # fmt: skip
    for split, found in (("test", summary.test), ("train", summary.train)):
        row |= {f"{split}_return_seeds": found.n}
        row |= {f"{split}_return_{name}": getattr(found, name) for name in ("iqm", "low", "high", "mean", "median")}
    row |= {
        "test_success": summary.test_success, "set_size": summary.set_size, "instances": summary.n_instances,
        "all_instances_reached": summary.reached, "all_instances_reached_at": summary.reached_at,
    }  # fmt: skip
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}


def _finals(runs: Sequence[Run], split: Split, measure: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([run.final(split, measure) for run in runs if run.evaluated_at_end], dtype=np.float64)


def _seeds(runs: Sequence[Run]) -> str:
    return f"seed{'s' if len(runs) > 1 else ''} {', '.join(str(run.status.seed) for run in runs)}"


def _steps(summary: Summary) -> str:
    if summary.steps is None:
        return NONE
    median, least, most = summary.steps
    return f"{median:,.0f}" if least == most else f"{median:,.0f} ({least:,}–{most:,})"


def _decimals(value: float) -> int:
    """So many that about four digits are shown."""
    return 3 if abs(value) < 10 else 2 if abs(value) < 100 else 1 if abs(value) < 10_000 else 0


def _number(value: float, decimals: int | None = None) -> str:
    return NONE if math.isnan(value) else f"{value:,.{_decimals(value) if decimals is None else decimals}f}"


def _interval(found: Estimate) -> str:
    """The IQM and its interval with equally many decimals."""
    if math.isnan(found.iqm):
        return NONE
    decimals = _decimals(found.iqm)
    if found.low is None or found.high is None:
        return f"{_number(found.iqm, decimals)} [{NONE}]"
    return f"{_number(found.iqm, decimals)} [{_number(found.low, decimals)}, {_number(found.high, decimals)}]"
