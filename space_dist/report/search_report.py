"""The report of a search: what was searched and what mattered, and, apart from it, what its choices are worth.

The best value of a search is the luckiest of many, measured on the instances that chose it: no result. What a tuned
setting reaches is what its confirmation reached, with fresh seeds on instances that the search has not seen.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from space_dist import config as configs
from space_dist.errors import ConfigError, LedgerError
from space_dist.experiment.manifest import Grid, Manifest
from space_dist.experiment.sampling import FEWEST_WEIGHED, importance
from space_dist.experiment.search import Search, Trial
from space_dist.experiment.status import run_statuses
from space_dist.experiment.tuning import confirmation_of
from space_dist.report.document import Document, Picture, Section, to_html, to_markdown, writing_to
from space_dist.report.figures import COLOURS, dress, empty_figure, plain, png, style_of
from space_dist.report.grid_report import GridReport, build_grid_report
from space_dist.report.objective import IN_WORDS
from space_dist.report.tables import NONE, Value, to_csv
from space_dist.system.files import atomic_write

MAX_LISTED: Final = 100  # failed trials; trials.csv has all
_COLUMNS: Final = 3
_METHOD: Final = tuple(
    " ".join(paragraph.split())
    for paragraph in f"""
Every arm has the same number of trials, and every trial that is not given up the same seeds. A trial's objective is one
number over its seeds. It chose the setting; it is not what the setting is worth: the greatest of many noisy numbers is
too great, the more so the more trials there are and the fewer seeds.

Complete: all seeds were run, to the end. Pruned: racing gave it up before that; of a population, another one has its
place, which went on from a better one's state under settings of its own. Failed: a run of it crashed, used more
memory or time than it may, or its objective is no number; the sampler is told so, and the search goes on.

Importance is the share of the objective's variance over an arm's complete trials that a setting explains, alone and
together with others (fANOVA, Hutter et al. 2014, computed by Optuna): of settings that all these trials have, from
{FEWEST_WEIGHED} complete trials on. It says what mattered within the ranges that were searched, and nothing beyond
them.""".split("\n\n")
)


@dataclass(frozen=True)
class SearchReport:
    """What `build_search_report` wrote into `folder`: report.md, report.html, trials.csv, and PNG figures.

    `summary` are sentences: how far the search is, and whether its choices are confirmed. `confirmation` is the report
    of the grid that confirms them, if there is one.
    """

    folder: Path
    summary: list[str]
    markdown: str
    confirmation: GridReport | None = None


def build_search_report(grid: Grid, out: Path | None = None) -> SearchReport:
    """Report on a search as it stands, and on its confirmation beside it; `out` is by default `report` in its folder.

    Raises ConfigError if the folder holds a grid and no search, or if `out` cannot be written to; LedgerError if the
    manifest is missing or damaged.
    """
    manifest = grid.manifest()
    search = manifest.search
    if search is None:
        raise ConfigError(f"{grid.folder} holds a grid, and no search: space-dist report {grid.folder}")
    folder = grid.folder / "report" if out is None else out
    with writing_to(folder):
        folder.mkdir(parents=True, exist_ok=True)
    confirmed, confirmation, of_confirmation = _confirmation(grid, manifest, search, folder)
    shares = {arm: importance(search, arm) for arm in search.arms}
    summary = [_how_far(search), of_confirmation]
    document = Document(
        f"Search {manifest.name}",
        [
            Section("", summary),
            *confirmed,
            _searched(grid, manifest, search),
            *_importance(shares),
            *_failed(search),
            Section("How to read this", _METHOD),
        ],
    )
    markdown = to_markdown(document)
    files = {
        **{picture.file: picture.png for section in document.sections for picture in section.pictures},
        "trials.csv": to_csv(_trial_rows(search)).encode(),
        "report.md": markdown.encode(),
        "report.html": to_html(document).encode(),
    }
    with writing_to(folder):
        for name, content in files.items():
            atomic_write(folder / name, content)
    return SearchReport(folder, summary, markdown, confirmation)


# ---- the search ------------------------------------------------------------------------------------------------------


def _how_far(search: Search) -> str:
    counts = Counter(trial.state for trial in search.trials)
    known = ", ".join(f"{counts[state]} {state}" for state in ("complete", "pruned", "failed", "open") if counts[state])
    if search.over:
        return f"The search is over: of {len(search.trials)} trials, {known}."
    return f"The search is not over: {search.asked} of {search.total} trials were asked: {known}."


def _searched(grid: Grid, manifest: Manifest, search: Search) -> Section:
    rows = _arms(grid, manifest, search)
    return Section("Search", [_about_search(search)], rows, pictures=_course(search), words=True)


def _about_search(search: Search) -> str:
    objective = search.config["objective"]
    level = "" if objective["threshold"] is None else f" of {objective['threshold']:g}"
    better = "more" if search.maximizes else "less"
    return (
        f"Trials were judged by the {IN_WORDS[objective['kind']]}{level}, one number over seeds, {better} is better. "
        "The settings below were chosen by it; none of its values is a result."
    )


def _arms(grid: Grid, manifest: Manifest, search: Search) -> list[dict[str, str]]:
    steps: Counter[str] = Counter()
    for one in run_statuses(grid, manifest, manifest.code):
        steps[one.run.cell.id] += one.steps
    rows = []
    for arm in search.arms:
        trials, best = search.of_arm(arm), search.best(arm)
        counts = Counter(trial.state for trial in trials)
        heirs = sum(trial.parent >= 0 for trial in trials)
        rows.append(
            {
                "arm": arm,
                "trials": f"{len(trials) - heirs}/{search.config['trials']}" + (f" + {heirs} heirs" if heirs else ""),
                **{state: str(counts[state]) for state in ("complete", "pruned", "failed")},
                "environment steps": f"{_steps_of(trials, steps):,}",
                "chosen": NONE if best is None else f"trial {best.number}",
                "setting": NONE if best is None else _course_of(search, best),
            }
        )
    return rows


def _steps_of(trials: Sequence[Trial], steps: Mapping[str, int]) -> int:
    """Environment steps that these trials took: trials of one setting share their runs, and heirs their beginning."""
    by_cell = {trial.cell: trial for trial in trials}
    return sum(steps[cell] - trial.inherited for cell, trial in by_cell.items() if cell in steps)


def _course_of(search: Search, trial: Trial) -> str:
    """Its settings, one after the other where they changed on the way."""
    first, schedule = search.in_force(trial)
    return "; ".join([_setting(first), *(f"from {one['steps']:,} steps {_setting(one['set'])}" for one in schedule)])


def _setting(parameters: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}: {_word(value)}" for key, value in parameters.items())


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _course(search: Search) -> list[Picture]:
    if not any(trial.values for trial in search.trials):
        return []
    caption = "Objective of each trial, in the order in which they were asked: what the search saw, and no result"
    return [Picture("trials.png", caption, png(draw_trials(search)))]


def draw_trials(search: Search) -> Figure:
    """The objective of every trial over its number, a colour an arm; hollow: given up, with its last rung's value."""
    figure = empty_figure(8.0, 4.4)
    axes = figure.subplots()
    for number, arm in enumerate(search.arms):
        colour = COLOURS[number % len(COLOURS)]
        for state, filled in (("complete", colour), ("pruned", "none")):
            found = [trial for trial in search.of_arm(arm) if trial.state == state]
            values = [trial.values[max(trial.values)] for trial in found]
            label = plain(arm if state == "complete" else f"{arm}, given up")
            if found:
                axes.scatter([trial.number for trial in found], values, s=26, facecolor=filled, edgecolor=colour,
                             marker="os^Dv"[number % 5], label=label)  # fmt: skip
    axes.set_xlabel("trial")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylabel(f"objective: {search.config['objective']['kind']}, over seeds")
    dress(axes, "What the search saw, on the development instances")
    axes.legend(frameon=False, fontsize=8)
    return figure


def _importance(shares: Mapping[str, Mapping[str, float]]) -> list[Section]:
    told = {arm: found for arm, found in shares.items() if found}
    if not told:
        return []
    keys = list(dict.fromkeys(key for found in told.values() for key in found))
    rows = [
        {"setting": key, **{arm: f"{found[key]:.2f}" if key in found else NONE for arm, found in told.items()}}
        for key in keys
    ]
    picture = Picture(
        "importance.png", "Share of the objective's variance that each setting explains", png(draw_importance(told))
    )
    return [Section("Importance of settings", rows=rows, pictures=[picture])]


def draw_importance(shares: Mapping[str, Mapping[str, float]]) -> Figure:
    """A diagram an arm: a bar for each searched key, the most important one on top."""
    columns = min(_COLUMNS, len(shares))
    rows = -(-len(shares) // columns)
    longest = max(len(found) for found in shares.values())
    figure = empty_figure(5.2 * columns, rows * (1.4 + 0.3 * longest))
    grid = figure.subplots(rows, columns, squeeze=False)
    for place, (axes, (arm, found)) in enumerate(zip(grid.flat, shares.items(), strict=False)):
        names = [plain(key) for key in found]
        axes.barh(names[::-1], [*found.values()][::-1], color=style_of(place)["color"])
        axes.set_xlim(0.0, 1.0)
        axes.set_xlabel("share of the variance")
        dress(axes, plain(arm))
    for axes in grid.flat[len(shares) :]:
        axes.set_axis_off()
    return figure


def _failed(search: Search) -> list[Section]:
    found = [trial for trial in search.trials if trial.state == "failed"]
    if not found:
        return []
    rows = [{"trial": f"{trial.arm} {trial.number}", "why": trial.remark, "setting": _setting(trial.parameters)}
            for trial in found[:MAX_LISTED]]  # fmt: skip
    text = [f"The first {MAX_LISTED} of {len(found)}; trials.csv has all."] if len(found) > MAX_LISTED else []
    return [Section("Failed trials", text, rows, words=True)]


def _trial_rows(search: Search) -> list[dict[str, Value]]:
    """Every trial, and what the search saw of it."""
    keys = list(dict.fromkeys(key for arm in search.arms.values() for key in arm.space))
    return [
        {
            "arm": trial.arm, "trial": trial.number, "generation": trial.generation, "state": trial.state,
            "cell": trial.cell, "parent": trial.parent if trial.parent >= 0 else None,
            "seeds": trial.seeds if trial.values else 0,
            "search_objective": trial.values[max(trial.values)] if trial.values else math.nan,
            **{key: None if key not in trial.parameters else _plain(trial.parameters[key]) for key in keys},
            "remark": trial.remark,
        }
        for trial in search.trials
    ]  # fmt: skip


def _plain(value: Any) -> Value:
    return value if isinstance(value, int | float | str) else str(value)


# ---- the confirmation ------------------------------------------------------------------------------------------------


def _confirmation(
    grid: Grid, manifest: Manifest, search: Search, out: Path
) -> tuple[list[Section], GridReport | None, str]:
    """What the confirming grid beside the search's reached, and a sentence on it; nothing where it is not of this one.

    Its own report is written below `out`.
    """
    confirming = Grid(grid.folder.parent / confirmation_of(manifest.name))
    none = "Its choices are not confirmed yet, so there is no number to report"
    if not search.over:
        return [], None, f"{none}: `space-dist tune run {grid.folder}` goes on, and what it chooses is confirmed then."
    if not confirming.manifest_file.exists():
        where = f"its runs are looked for in {confirming.folder}"
        return [], None, f"{none}: {where}; {_next_step(grid, manifest, search)}."
    try:
        found = confirming.manifest()
    except LedgerError as error:
        return [], None, f"{none}: {error}."
    if fault := _not_of_this(_frozen_choice(found, search), manifest, search):
        return [], None, f"{none}: {confirming.folder} {fault}; {_next_step(grid, manifest, search)}."
    made = build_grid_report(confirming, out / "confirmation", in_depth=False)
    curves = made.folder / "curves.png"
    pictures = [
        Picture("confirmation.png", "Learning curves of the confirmation", curves.read_bytes())
    ] if curves.exists() else []  # fmt: skip
    seeds = len(found.seeds)
    text = [
        f"The chosen setting of each arm, {seeds} fresh seed{'s' if seeds > 1 else ''}, on the final instances, which "
        "the search has not seen.",
        *made.summary,
    ]
    done = made.summary[0]
    return [Section("Confirmation", text, made.table, made.remarks, pictures)], made, f"Confirmation: {done}"


@dataclass(frozen=True)
class _Choice:
    """What a grid confirms, frozen or only written: the run config of each arm, and the seeds of all."""

    seeds: Sequence[int]
    configs: Mapping[str, Mapping[str, Any]]


def _frozen_choice(found: Manifest, search: Search) -> _Choice:
    cells = {Path(str(cell.settings.get("extends", ""))).stem: cell.config for cell in found.cells}
    if len(search.arms) == 1 and len(found.cells) == 1:
        cells = {next(iter(search.arms)): found.cells[0].config}
    return _Choice(found.seeds, cells)


def _written_choice(file: Path) -> _Choice:
    """Raises ConfigError where `tune confirm` has written none, or somebody something else."""
    try:
        whole = configs.read_yaml(file)
        arms = {Path(name).stem: configs.read_yaml(file.with_name(Path(name).name)) for name in whole["extends"]}
        for config in arms.values():  # relative to the folder of the file, which is one below the search's
            config["instances"] = {split: path.removeprefix("../") for split, path in config["instances"].items()}
        return _Choice([*whole["seeds"]], arms)
    except (AttributeError, KeyError, TypeError):
        raise ConfigError(f"{file} is not as it was written") from None


def _next_step(grid: Grid, manifest: Manifest, search: Search) -> str:
    """Which of the two steps to a confirmation is missing: to write the grid of what was chosen, or to run it."""
    file = grid.folder / "confirm" / f"{confirmation_of(manifest.name)}.yaml"
    try:
        is_written = not _not_of_this(_written_choice(file), manifest, search)
    except ConfigError:
        is_written = False
    if is_written:
        return f"`space-dist grid run {file} --root {grid.folder.parent}` runs the grid that does it"
    anew = " anew" if file.exists() else ""
    return f"`space-dist tune confirm {grid.folder}` writes the grid that does it{anew}, which is to be run then"


def _not_of_this(choice: _Choice, manifest: Manifest, search: Search) -> str:
    """Why a grid confirms nothing of this search; empty if it does."""
    if {*choice.seeds} & {*manifest.seeds}:
        return "has seeds of the search"
    if choice.configs.keys() != search.arms.keys():
        return "has other arms than the search"
    for arm, config in choice.configs.items():
        best = search.best(arm)
        first, schedule = ({}, []) if best is None else search.in_force(best)
        same = all(_same(config, key, value) for key, value in first.items())
        if best is None or not same or list(config.get("schedule", ())) != schedule:
            return f"has another setting of {arm} than the search has chosen"
        if dict(config["instances"]) != dict(search.final):
            return "has other instances than confirm.instances names"
    return ""


def _same(config: Mapping[str, Any], key: str, value: Any) -> bool:
    found: Any = config
    for part in key.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    if isinstance(value, Mapping):  # a whole section: defaults were added to it
        return isinstance(found, Mapping) and all(found.get(name) == one for name, one in value.items())
    if isinstance(value, float) and isinstance(found, int | float):
        return bool(np.isclose(found, value, rtol=1e-12, atol=0.0))
    return bool(found == value)
