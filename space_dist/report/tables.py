"""The numbers of configurations, as text for tables and in full precision for CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from space_dist.report.load import (
    SPLITS,
    Configuration,
    FloatArray,
    Run,
    Split,
    fingerprint_differences,
    state_in_words,
)
from space_dist.report.statistics import ENOUGH, FEWEST, Estimate, Interval, estimates, intervals

NONE = "—"
MAX_NAMED: Final = 6  # labels that a sentence names
Value = str | int | float | None


@dataclass(frozen=True)
class Summary:
    """One configuration in numbers; all but `n_runs`, its seeds, are over its finished runs alone.

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


def summarise(configurations: Sequence[Configuration]) -> list[Summary]:
    """The numbers of each configuration."""
    finished = [configuration.finished for configuration in configurations]
    test = estimates([finals(runs, "test", "return") for runs in finished])
    train = estimates([finals(runs, "train", "return") for runs in finished])
    success = intervals([finals(runs, "test", "success") for runs in finished], "mean")
    return [
        _summary(*parts) for parts in zip(configurations, test, train, (found.value for found in success), strict=True)
    ]


def _summary(configuration: Configuration, test: Estimate, train: Estimate, success: float) -> Summary:
    runs = configuration.finished
    steps = [run.status.steps for run in runs]
    reached = [at for run in runs if (at := run.all_instances_reached_at) is not None]
    sized = [run for run in runs if len(run.set_sizes) and not run.generates_contexts]
    return Summary(
        label=configuration.label,
        n_runs=configuration.n_seeds,
        n_finished=len(runs),
        steps=(float(np.median(steps)), min(steps), max(steps)) if steps else None,
        test=test,
        train=train,
        test_success=success,
        set_size=float(np.median([run.set_sizes[-1] for run in sized])) if sized else None,
        n_instances=float(np.median([len(run.instance_ids) for run in sized])) if sized else None,
        reached=len(reached),
        reached_at=float(np.median(reached)) if reached else None,
    )


def remarks(configuration: Configuration) -> list[str]:
    """All that the table alone would hide about a configuration's runs, a sentence each."""
    label, lines = configuration.label, []
    unfinished = [run for run in configuration.runs if not run.finished]
    if unfinished:
        parts = [f"seed {run.status.seed} {state_in_words(run)}" for run in unfinished]
        lines.append(f"{label}, not finished and not counted: {'; '.join(parts)}.")
    lines += caveats(configuration)
    for field, values in fingerprint_differences(configuration.runs).items():
        lines.append(f"{label}: its runs differ in {field}: {', '.join(values)}.")
    if moved := [run for run in configuration.runs if run.status.fingerprint_changed]:
        lines.append(f"{label}: resumed with another arithmetic or other library versions: {_seeds(moved)}.")
    return lines


def few_seeds(counts: Mapping[str, int]) -> list[str]:
    """What is to be known before intervals over a few seeds are read; `counts`: how many seeds each label has."""
    without = {label: count for label, count in counts.items() if 0 < count < FEWEST}
    few = {label: count for label, count in counts.items() if FEWEST <= count < ENOUGH}
    sentences = []
    if few:
        sentences.append(
            f"Intervals here rest on fewer than {ENOUGH} seeds ({_counts(few)}): they are wide, and cover their "
            "95 % only if the seeds are much alike. Where some seeds fail, or all end at the same limit, an interval "
            "over three seeds covers 81 to 90 %, one over five 93 to 96 %."
        )
    if without:
        sentences.append(
            f"Over fewer than {FEWEST} seeds there is no interval ({_counts(without)}): one seed cannot tell how far "
            "seeds differ, and two hardly can."
        )
    return sentences


def _counts(seeds: Mapping[str, int]) -> str:
    """`space: 3; round_robin: 2`, of the first few labels, and how many more there are."""
    named = [f"{label}: {count}" for label, count in list(seeds.items())[:MAX_NAMED]]
    return "; ".join([*named, *([f"and {len(seeds) - MAX_NAMED:,} more"] if len(seeds) > MAX_NAMED else [])])


def share_text(n: int, of: int, what: str) -> str:
    """`9/10 seeds`, `1/1 seed`."""
    return f"{n}/{of} {what}{'' if of == 1 else 's'}"


def caveats(configuration: Configuration) -> list[str]:
    """What is peculiar about the numbers and curves of its finished runs, a sentence each."""
    label, lines = configuration.label, []
    if unevaluated := [run for run in configuration.finished if not run.evaluated_at_end]:
        lines.append(f"{label}, finished but without a final evaluation, not counted in the returns: "
                     f"{_seeds(unevaluated)}.")  # fmt: skip
    counted = [run for run in configuration.finished if run.evaluated_at_end]
    for split in SPLITS:
        broken = [run for run in counted if math.isnan(run.last(split, "return"))]
        lines += [f"{label}: the final {split} return is not a finite number for {_seeds(broken)}, so there is none "
                  "over the seeds."] if broken else []  # fmt: skip
    if len({tuple(run.evaluation_steps.tolist()) for run in configuration.drawn}) > 1:
        lines.append(f"{label}: its seeds were evaluated at different steps; between its evaluations, and behind its "
                     "end, a run's last one is drawn.")  # fmt: skip
    return lines


def cells(summary: Summary) -> dict[str, str]:
    """One row of the table as text: column -> cell."""
    return {
        "configuration": summary.label,
        "seeds finished": f"{summary.n_finished}/{summary.n_runs}",
        "environment steps": steps_text(summary),
        "test return, IQM [95 %]": interval_text(summary.test.iqm),
        "test return, mean": number_text(summary.test.mean.value),
        "test return, median": number_text(summary.test.median.value),
        "train return, IQM [95 %]": interval_text(summary.train.iqm),
        "test success": number_text(summary.test_success),
        "set size at the end": size_text(summary),
        "all instances reached": reached_text(summary),
    }


def to_csv(rows: Sequence[Mapping[str, Value]]) -> str:
    """Rows that all have the same columns; a number that does not exist is an empty cell.

    A word that a spreadsheet would take for a formula is kept from it by an apostrophe.
    """
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _csv_value(value) for name, value in row.items()} for row in rows)
    return buffer.getvalue()


def _csv_value(value: Value) -> Value:
    if isinstance(value, float) and math.isnan(value):
        return None
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value


def numbers(summary: Summary) -> dict[str, Value]:
    """One row in full precision: column -> number."""
    middle, least, most = summary.steps or (None, None, None)
    row: dict[str, Value] = {
        "configuration": summary.label, "runs": summary.n_runs, "finished": summary.n_finished,
        "steps_median": middle, "steps_min": least, "steps_max": most,
    }  # fmt: skip
    for split, found in (("test", summary.test), ("train", summary.train)):
        row |= {f"{split}_return_seeds": found.n}
        for name in ("iqm", "mean", "median"):
            row |= interval_numbers(f"{split}_return_{name}", getattr(found, name))
    return row | {
        "test_success": summary.test_success, "set_size": summary.set_size, "instances": summary.n_instances,
        "all_instances_reached": summary.reached, "all_instances_reached_at": summary.reached_at,
    }  # fmt: skip


def interval_numbers(name: str, found: Interval) -> dict[str, Value]:
    """An interval as three columns."""
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


def finals(runs: Sequence[Run], split: Split, measure: str) -> FloatArray:
    """`(n,)` final means over the instances, of the runs that were evaluated at their end."""
    return np.array([run.last(split, measure) for run in runs if run.evaluated_at_end], dtype=np.float64)


def _seeds(runs: Sequence[Run]) -> str:
    return f"seed{'s' if len(runs) > 1 else ''} {', '.join(str(run.status.seed) for run in runs)}"


def steps_text(summary: Summary) -> str:
    """How long the finished runs were: the median, and the range where they differ."""
    if summary.steps is None:
        return NONE
    middle, least, most = summary.steps
    return f"{middle:,.0f}" if least == most else f"{middle:,.0f} ({least:,}–{most:,})"


def size_text(summary: Summary) -> str:
    """The size of the last set."""
    if summary.set_size is None or summary.n_instances is None:
        return NONE
    return f"{summary.set_size:,g} of {summary.n_instances:,g}"


def reached_text(summary: Summary) -> str:
    """How many runs were trained on all their instances at once, and since when."""
    if not summary.n_finished or summary.set_size is None:
        return NONE
    at = "" if summary.reached_at is None else f" at {summary.reached_at:,.0f} steps"
    return f"{summary.reached}/{summary.n_finished}{at}"


def _decimals(value: float) -> int:
    """So many that about four digits are shown."""
    return 3 if abs(value) < 10 else 2 if abs(value) < 100 else 1 if abs(value) < 10_000 else 0


def number_text(value: float, decimals: int | None = None) -> str:
    """A number with about four digits."""
    return NONE if math.isnan(value) else f"{value:,.{_decimals(value) if decimals is None else decimals}f}"


def interval_text(found: Interval, decimals: int | None = None) -> str:
    """A number and its interval with equally many decimals."""
    if math.isnan(found.value):
        return NONE
    decimals = _decimals(found.value) if decimals is None else decimals
    bounds = NONE
    if found.low is not None and found.high is not None:
        bounds = f"{number_text(found.low, decimals)}, {number_text(found.high, decimals)}"
    return f"{number_text(found.value, decimals)} [{bounds}]"
