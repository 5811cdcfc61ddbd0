"""What of a run is to be shown elsewhere, read from its folder before any sink is asked anything."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from space_dist.config import flattened
from space_dist.errors import LedgerError
from space_dist.ledger import METRICS, TIMING, Ledger, Row, Status

STARTED_TAG: Final = "space_dist.started"
LEVEL_TAG: Final = "space_dist.level"  # grid, cell or run
NOTE_TAG: Final = "mlflow.note.content"  # a run's description, in Markdown

MAX_TAG, _MAX_PARAM, _MAX_KEY = 8000, 6000, 250  # characters; mlflow/utils/validation.py


class Point(NamedTuple):
    """One number of a curve. milliseconds: since the epoch. step: real environment steps."""

    name: str
    value: float
    milliseconds: int
    step: int


class Record(Protocol):
    """What every sink can show: a run, or a cell of a grid.

    Its rows come in order and never change, except where `continues` says so. All is plain: text, numbers, paths.
    """

    @property
    def key(self) -> str:
        """`(32 hex digits)` by which it is found again."""

    @property
    def title(self) -> str:
        """What it is called."""

    @property
    def root(self) -> Path:
        """The folder of the run outside grids, or of the grid: local sinks write into folders of their own there."""

    @property
    def name(self) -> str:
        """Its place among what is in `root`: a relative path of plain letters, empty for a run outside grids."""

    @property
    def group(self) -> str:
        """What it belongs to: the label of a cell, or a run's name."""

    @property
    def params(self) -> Mapping[str, str]:
        """`section.key` -> text of what stays constant."""

    @property
    def tags(self) -> Mapping[str, str]:
        """The others, which may change."""

    @property
    def mlflow_status(self) -> str:
        """RUNNING, FINISHED, FAILED or KILLED."""

    @property
    def started_at(self) -> float:
        """Seconds since the epoch."""

    @property
    def ended_at(self) -> float:
        """Seconds since the epoch."""

    @property
    def stamp(self) -> str:
        """Changes whenever anything that is pushed does; empty where that is not known."""

    @property
    def intent(self) -> str:
        """What its rows are; noted wherever they go before the first of them goes there."""

    def continues(self, intent: str) -> bool:
        """Whether rows that were noted so are the first ones of these."""

    def points(self, start: int) -> Iterator[tuple[int, Point]]:
        """(rows complete once this is pushed, point) from row `start` on."""


@dataclass(frozen=True)
class Part:
    """What a run is as a part of a grid.

    key: `(32 hex digits)` of grid, cell and seed. title: the child's name. remark: the end of its description.
    root, name, group: as those of a `Record`. tags: more of them. ending: how it stands in MLflow's words. ended_at:
    seconds since the epoch. stamp: changes whenever anything that is pushed does; a child that has it is up to date.
    shows_episodes: whether its policy is drawn when it is done: drawing takes seconds, so one seed of a cell is enough.
    """

    key: str
    title: str
    remark: str
    root: Path
    name: str
    group: str
    tags: Mapping[str, str]
    ending: str
    ended_at: float
    stamp: str
    shows_episodes: bool


@dataclass(frozen=True)
class Snapshot:
    """What of a run is to be mirrored, read before MLflow is asked anything.

    started: whether its folder held a run then; of some attempts nothing is left but why they failed.
    """

    ledger: Ledger
    status: Status
    alive: bool
    config: Mapping[str, Any]
    rows: Sequence[Row]
    timing: Sequence[Row]
    note: str  # Markdown: what the run is, where it stands, and how it did
    part: Part | None = None
    started: bool = True

    @property
    def key(self) -> str:
        """`(32 hex digits)`: this run and no other. Outside grids, also when another one starts in its folder."""
        if self.part is not None:
            return self.part.key
        return key_of(str(self.ledger.folder.resolve()), repr(self.status.started_at))

    @property
    def title(self) -> str:
        """What the run is called in MLflow."""
        return self.part.title if self.part is not None else f"{self.status.name}-s{self.status.seed}"

    @property
    def root(self) -> Path:
        """Its grid's folder, or its own."""
        return self.part.root if self.part is not None else self.ledger.folder

    @property
    def name(self) -> str:
        """Its place among the runs of its grid."""
        return self.part.name if self.part is not None else ""

    @property
    def group(self) -> str:
        """The label of its cell, or its name."""
        return self.part.group if self.part is not None else self.status.name

    @property
    def mlflow_status(self) -> str:
        """RUNNING, FINISHED, FAILED or KILLED."""
        if self.part is not None:
            return self.part.ending
        if self.status.state == "running":
            return "RUNNING" if self.alive else "KILLED"
        return {"done": "FINISHED", "paused": "FINISHED", "failed": "FAILED", "interrupted": "KILLED"}[
            self.status.state
        ]

    @property
    def started_at(self) -> float:
        """Seconds since the epoch."""
        return self.status.started_at

    @property
    def ended_at(self) -> float:
        """Seconds since the epoch."""
        return self.part.ended_at if self.part is not None else self.status.updated_at

    @property
    def stamp(self) -> str:
        """Of a part of a grid."""
        return self.part.stamp if self.part is not None else ""

    @property
    def intent(self) -> str:
        """When the run was first started: rows of another one in its folder are others."""
        return repr(self.status.started_at)

    def continues(self, intent: str) -> bool:
        """Whether rows are of this run."""
        return intent == self.intent

    @property
    def params(self) -> dict[str, str]:
        """Its config."""
        return as_params(self.config)

    @property
    def tags(self) -> dict[str, str]:
        """Where it stands, and what computed it."""
        return _tags_of(self)

    def points(self, start: int) -> Iterator[tuple[int, Point]]:
        """(rows complete once this is pushed, point) from row `start` on, each row's own time and real step."""
        constant = _constant(self.config)
        for index in range(start, len(self.rows)):
            row, timing = self.rows[index], self.timing[index]
            try:
                milliseconds, steps, rate = (
                    round(timing["unix_time"] * 1000),
                    int(row["steps"]),
                    timing["steps_per_second"],
                )
                numbers = [(name, value) for name, value in _numbers(row) if name not in constant]
            except (KeyError, TypeError, AttributeError, ValueError) as error:
                raise LedgerError(f"{self.ledger.folder / METRICS}, row {index + 1}: {error!r}") from None
            if rate is not None:
                numbers.append(("time/steps_per_second", float(rate)))
            for position, (name, value) in enumerate(numbers):
                yield index + (position + 1 == len(numbers)), Point(name, value, milliseconds, steps)


def key_of(*parts: str) -> str:
    """`(32 hex digits)` by which something is found again."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def read_snapshot(
    ledger: Ledger, status: Status, alive: bool, config: Mapping[str, Any], part: Part | None = None
) -> Snapshot:
    """What of a run is to be mirrored now. Raises LedgerError if its files are damaged."""
    try:
        rows = ledger.rows(METRICS, committed_only=True)
        timing = ledger.rows(TIMING, committed_only=True)  # after the rows: it has one for each of them by now
    except OSError as error:
        raise LedgerError(f"{error.filename} cannot be read: {error.strerror}") from None
    if len(timing) < len(rows):
        raise LedgerError(f"{ledger.folder / TIMING} has {len(timing)} rows where {METRICS} has {len(rows)}")
    try:
        note = describe_run(ledger, status, config, rows)
    except (KeyError, TypeError, ValueError) as error:
        raise LedgerError(f"{ledger.folder / METRICS} has rows that this version cannot read: {error!r}") from None
    if part is not None:
        note += f"\n\n{part.remark}"
    return Snapshot(ledger, status, alive, config, rows, timing, note, part)


_GROUPS: Final = {"test": "test/", "train": "train/", "rollout": "train/rollout_", "learner": "train/learner_",
                  "curriculum": "curriculum/"}  # fmt: skip


def _numbers(row: Row) -> Iterator[tuple[str, float]]:
    """(metric name, value) of each number of a row; per-instance lists, nulls and words are none.

    Dashboards put those together that have the part before the slash in common.
    """
    sections = ("train", "test") if row["kind"] == "evaluation" else ("rollout", "learner", "curriculum")
    for section in sections:
        for name, value in row[section].items():
            if isinstance(value, int | float):
                yield f"{_GROUPS[section]}{name}", float(value)
    if row["kind"] == "iteration":
        for name, value in row.items():
            if isinstance(value, int | float) and name not in ("steps", "complete"):
                yield f"time/{name}", float(value)


def _constant(config: Mapping[str, Any]) -> set[str]:
    """Metrics that say a setting again at every step: what stays constant is a parameter."""
    learner = config.get("learner")
    own: Mapping[str, Any] = learner if isinstance(learner, Mapping) else {}
    return {
        f"{_GROUPS['learner']}{key}" for key in ("learning_rate", "clip_range")
        if key in own and own.get(f"{key}_schedule", "constant") == "constant"
    }  # fmt: skip


def as_params(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """`section.key` -> text, as long as MLflow takes; lists as JSON."""
    texts = ((key, value if isinstance(value, str) else json.dumps(value, default=str))
             for key, value in flattened(config, prefix, empty=True))  # fmt: skip
    return {key[:_MAX_KEY]: text[:_MAX_PARAM] for key, text in texts}


def _tags_of(snapshot: Snapshot) -> dict[str, str]:
    status = snapshot.status
    tags = {
        "space_dist.seed": str(status.seed),
        "space_dist.name": status.name,
        LEVEL_TAG: "run",
        "space_dist.state": status.state,
        STARTED_TAG: repr(status.started_at),
        "space_dist.folder": str(snapshot.ledger.folder),
        "space_dist.fingerprint_changed": str(status.fingerprint_changed).lower(),
        **{f"space_dist.fingerprint.{key}": str(value) for key, value in status.fingerprint.items()},
        NOTE_TAG: snapshot.note,
        **(snapshot.part.tags if snapshot.part is not None else {}),
    }
    return {key: value[:MAX_TAG] for key, value in tags.items()}


def describe_run(ledger: Ledger, status: Status, config: Mapping[str, Any], rows: Sequence[Row]) -> str:
    flat = as_params(config)
    what = " · ".join(flat[key] for key in ("curriculum.kind", "learner.kind", "env.id") if key in flat)
    lines = [
        f"**{status.name}**, seed {status.seed}: {what}",
        "",
        f"- {status.state}, {status.steps:,} of {status.budget_steps:,} environment steps",
    ]
    if status.message:
        lines.append(f"- {status.message.splitlines()[0][:500]}")
    evaluations = [row for row in rows if row["kind"] == "evaluation"]
    if evaluations:
        last = evaluations[-1]
        when = "at the end" if status.state == "done" else f"at {last['steps']:,} steps"
        lines += [f"- {split} return {when}: {_shown(last[split]['return'])}, success {_shown(last[split]['success'])}"
                  for split in ("test", "train")]  # fmt: skip
    lines.append(f"- folder `{ledger.folder}`")
    return "\n".join(lines)


def _shown(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"
