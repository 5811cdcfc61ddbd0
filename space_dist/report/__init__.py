"""Reports: ledgers in; a figure, a table and their caveats out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from space_dist.errors import ConfigError
from space_dist.ledger import Ledger
from space_dist.report.document import Document, Picture, Section, to_markdown
from space_dist.report.figures import draw_comparison, draw_contexts, draw_curriculum, draw_learning_curve, png, save
from space_dist.report.grid_report import GridReport, build_grid_report
from space_dist.report.load import Configuration, Run, group, load_run, read_config
from space_dist.report.statistics import Estimate, Interval, confidence_interval, estimate, interquartile_mean
from space_dist.report.tables import Summary, cells, few_seeds, numbers, remarks, summarise, to_csv
from space_dist.system.files import atomic_write

__all__ = [
    "Configuration",
    "Estimate",
    "GridReport",
    "Interval",
    "Report",
    "Run",
    "Summary",
    "build_grid_report",
    "build_report",
    "confidence_interval",
    "draw_comparison",
    "draw_contexts",
    "draw_curriculum",
    "draw_learning_curve",
    "estimate",
    "group",
    "interquartile_mean",
    "load_run",
    "read_config",
    "save",
    "summarise",
]

_METHOD = """\
Final numbers are those of each finished run's evaluation at its last step; returns are undiscounted means over the
instances. IQM: interquartile mean over seeds (below four seeds the plain mean). [95 %]: an interval over
seeds from Student's t and winsorised values; below three seeds there is none (docs/reports.md). Curves show
finished runs (while there is none, unfinished ones); where seeds were evaluated at different steps, each counts with
its last evaluation. Bands are the same intervals. Steps are real environment steps of training. "All instances
reached": finished runs that were trained on all their instances at once, and from which step on (median over those)."""


@dataclass(frozen=True)
class Report:
    """What `build_report` wrote.

    `table` has one dict (column -> text) a configuration, with the same columns in all; `remarks` are sentences that
    belong below it.
    """

    table: list[dict[str, str]]
    remarks: list[str]
    summaries: list[Summary]
    markdown: str
    figure: Path


def build_report(ledgers: Sequence[Ledger], out: Path, *, not_begun: Sequence[str] = ()) -> Report:
    """Compare runs: writes `report.png`, `report.md` and `report.csv` into `out`, which is created.

    not_begun: sentences on runs that have no ledger yet.

    Raises ConfigError if there are no ledgers, if a configuration has the same seed twice, or if `out` cannot be
    written to; LedgerError if a ledger is damaged.
    """
    if not ledgers:
        raise ConfigError("there are no runs to report on")
    configurations = group([load_run(ledger) for ledger in ledgers])
    summaries = summarise(configurations)
    table = [cells(summary) for summary in summaries]
    few = few_seeds({summary.label: summary.test.n for summary in summaries})
    notes = [line for configuration in configurations for line in remarks(configuration)]
    notes += not_begun
    picture = Picture("report.png", "Learning curves and set sizes", png(draw_comparison(configurations)))
    found = Section("", few, table, notes, [picture])
    document = Document("Report", [found, Section("How to read this", [_METHOD])])
    markdown = to_markdown(document)
    try:
        out.mkdir(parents=True, exist_ok=True)
        atomic_write(out / picture.file, picture.png)
        atomic_write(out / "report.md", markdown.encode())
        atomic_write(out / "report.csv", to_csv([numbers(summary) for summary in summaries]).encode())
    except OSError as error:
        raise ConfigError(f"the report cannot be written to {out}: {error.strerror or error}") from None
    return Report(table, few + notes, summaries, markdown, out / "report.png")
