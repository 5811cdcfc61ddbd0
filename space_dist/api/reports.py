"""Reports from Python: tables as data, and figures that notebooks show inline."""

from __future__ import annotations

import base64
import contextlib
import csv
import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from space_dist.api.arguments import as_path
from space_dist.config import located
from space_dist.config.quoting import short
from space_dist.errors import ConfigError, LedgerError, counted
from space_dist.experiment.manifest import MANIFEST, find_grid, grids_below
from space_dist.ledger import Ledger, find_ledgers
from space_dist.report import build_grid_report, build_report
from space_dist.system.workplace import workplace

_YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class ReportView:
    """A report that was written into `folder`.

    table: a dict (column -> text) for each configuration or cell, as people read it.  numbers: the same rows as
    numbers, from the report's CSV file; None: there is none.  remarks: sentences that belong below.  figures: PNG files
    by their name.
    """

    folder: Path
    table: list[dict[str, str]]
    numbers: list[dict[str, float | str | None]]
    remarks: list[str]
    markdown: str
    figures: dict[str, Path]

    def __str__(self) -> str:
        return self.markdown

    def __repr__(self) -> str:
        return f"ReportView({str(self.folder)!r}, rows: {len(self.table)}, figures: {len(self.figures)})"

    def _repr_html_(self) -> str:
        """The table, what belongs below it, and the figures, as notebooks show them."""
        columns = [*self.table[0]] if self.table else []
        head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
        body = "".join(
            f"<tr>{''.join(f'<td>{html.escape(row[column])}</td>' for column in columns)}</tr>" for row in self.table
        )
        notes = "".join(f"<li>{html.escape(remark)}</li>" for remark in self.remarks)
        return f"<table><tr>{head}</tr>{body}</table><ul>{notes}</ul>" + "".join(map(_image, self.figures.values()))


def _image(path: Path) -> str:
    shown = base64.b64encode(path.read_bytes()).decode()
    return f'<p><img alt="{html.escape(path.stem)}" src="data:image/png;base64,{shown}"></p>'


def report_on(
    paths: Path | str | Sequence[Path | str],
    *,
    out: Path | str | None = None,
    baseline: str | None = None,
    threshold: float | None = None,
    root: Path | str | None = None,
) -> ReportView:
    """Compare runs, or the cells of a grid, as `space-dist report` does: 95 % intervals over seeds.

    paths: folders of runs, or that hold some; or one grid: its folder, or its YAML file, frozen below `root` (None:
    `runs` here).  out: the folder for tables and figures; None: `report` here, or in the grid's folder.  baseline,
    threshold: of a grid: the cell to compare with, and the test return to reach.

    Raises ConfigError where nothing is named, if the grid is not given alone, and for an unknown baseline; LedgerError
    if there are no runs in what is named.
    """
    given = [located(as_path(path, "paths")) for path in _listed(paths)]
    grids = [path for path in given if is_grid(path)]
    folder = None if out is None else as_path(out, "out")
    if not grids:
        if baseline is not None or threshold is not None:
            raise ConfigError(f"baseline and threshold are for grids; {', '.join(map(str, given))} is none")
        ledgers = find_ledgers(given)
        found = build_report(ledgers, Path("report") if folder is None else folder, not_begun=not_begun(given, ledgers))
        place = found.figure.parent
        return ReportView(
            place,
            found.table,
            _numbers(place / "report.csv"),
            found.remarks,
            found.markdown,
            _pictures(found.markdown, place),
        )
    if len(given) > 1:
        raise ConfigError(f"{grids[0]} is a grid: give it alone, for each grid has a report of its own")
    grid = find_grid(grids[0], workplace() / "runs" if root is None else as_path(root, "root"))
    made = build_grid_report(grid, folder, baseline=baseline, threshold=threshold)
    return ReportView(
        made.folder, made.table, _numbers(made.folder / "cells.csv"), [*made.summary, *made.remarks], made.markdown,
        _pictures(made.markdown, made.folder),
    )  # fmt: skip


def _listed(paths: object) -> Sequence[Path | str]:
    """One path or several, as a list. Raises ConfigError for what is neither, and for none at all."""
    if isinstance(paths, str | Path):
        return [paths]
    if not isinstance(paths, Iterable) or not (several := list(paths)):
        raise ConfigError(f"paths must be a folder or a list of them, not {short(paths)}")
    return several


def is_grid(path: Path) -> bool:
    """Whether a path names a grid: a folder with a manifest, or a file."""
    return (path / MANIFEST).is_file() or (not path.is_dir() and (path.name == MANIFEST or path.suffix in _YAML))


def not_begun(paths: Sequence[Path], ledgers: Sequence[Ledger]) -> list[str]:
    """How many runs of the grids below these folders a report of their ledgers leaves out, a sentence a grid."""
    begun, sentences = {ledger.folder.resolve() for ledger in ledgers}, []
    for grid in {grid.folder.resolve(): grid for path in paths for grid in grids_below(path)}.values():
        with contextlib.suppress(LedgerError):  # of a damaged manifest, `grid status` tells
            runs = grid.manifest().runs()
            left_out = sum(grid.ledger(run).folder.resolve() not in begun for run in runs)
            have = "have" if left_out > 1 else "has"
            of = f"{counted(left_out, 'run')} of the grid {grid.folder.name}"
            sentences += [f"{of} {have} not begun, and {have} no part in this."] if left_out else []
    return sentences


def _pictures(markdown: str, folder: Path) -> dict[str, Path]:
    """The figures that a report shows, in their order."""
    names = [part.partition(")")[0] for part in markdown.split("](")[1:]]
    return {Path(name).stem: folder / name for name in names if name.endswith(".png")}


def _numbers(path: Path) -> list[dict[str, float | str | None]]:
    rows = csv.DictReader(io.StringIO(path.read_text()))
    return [{column: _number(text) for column, text in row.items()} for row in rows]


def _number(text: str) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text
